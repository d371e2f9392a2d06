"""Elements of any kind: laws, forces, and the lanes of a CPU's vector registers."""
