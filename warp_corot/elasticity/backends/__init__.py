"""How forces of a law are launched: by subtrees, in clusters, or in the lanes of vector registers."""
