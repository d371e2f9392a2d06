"""The integer lattice that vertices of a forest lie on."""

import numpy as np

#: A root cube has 2**LATTICE_BITS lattice intervals a side, so levels may go to 3 * LATTICE_BITS.
LATTICE_BITS = 16
MAX_LEVEL = 3 * LATTICE_BITS


def volume_shares(level: np.ndarray | int) -> np.ndarray:
    """Volume of tetrahedra of these levels over that of a root cube."""
    all_levels = np.arange(MAX_LEVEL + 1)
    return (0.125 ** (all_levels // 3) / np.array([6.0, 12.0, 24.0])[all_levels % 3])[level]
