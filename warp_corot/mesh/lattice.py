"""The integer lattice that vertices of a forest lie on."""

#: A root cube has 2**LATTICE_BITS lattice intervals a side, so levels may go to 3 * LATTICE_BITS.
LATTICE_BITS = 16
MAX_LEVEL = 3 * LATTICE_BITS
