"""Random numbers that depend only on what they are for, so that they are the same on any number of processes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def uniform_numbers(numbers: npt.NDArray[np.integer], stream: int) -> npt.NDArray[np.float64]:
    """Uniformly distributed random numbers, above 0 and up to 1, float64 [n].

    They come from SplitMix64 (Steele, Lea and Flood 2014).

    Args:
        numbers: What each of them is for, 64 bits [n].
        stream: Other streams give other numbers.
    """
    with np.errstate(over="ignore"):
        state = numbers.astype(np.uint64) * np.uint64(64) + np.uint64(stream)
        state = (state + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return ((state >> np.uint64(11)).astype(np.float64) + 1.0) * 2.0**-53


def normal_numbers(numbers: npt.NDArray[np.int64], seed: int) -> npt.NDArray[np.float64]:
    """Three normally distributed random numbers for each node, by Box and Muller's transform, float64 [n, 3].

    Args:
        numbers: Numbers of the nodes, int64 [n].
        seed: The seed of the numbers.
    """
    found = np.empty((len(numbers), 3))
    for axis in range(3):
        first, second = (uniform_numbers(numbers, seed * 6 + 2 * axis + half) for half in range(2))
        found[:, axis] = np.sqrt(-2.0 * np.log(first)) * np.cos(2.0 * np.pi * second)
    return found


def padded(vectors: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.float32]:
    """Vectors [n, 3] in the first of ``count`` rows of vec4, which are zero elsewhere, float32 [count, 4]."""
    found = np.zeros((count, 4), np.float32)
    found[: len(vectors), :3] = vectors
    return found


def weights_within(lattice: npt.NDArray[np.integer], count: int) -> npt.NDArray[np.float64]:
    """Barycentric coordinates of points that are evenly distributed over the eighths of tetrahedra, float64 [n, count,
    4].

    Args:
        lattice: The sums of the coordinates of each tetrahedron's corners, integers [n, 3]; they name it.
        count: The number of points in each.
    """
    with np.errstate(over="ignore"):
        names = lattice.astype(np.uint64) * np.array([0x9FB21C651E98DF25, 0xD6E8FEB86659FD93, 0xA0761D6478BD642F], "u8")
    names = names.sum(axis=1, dtype=np.uint64)
    drawn = np.stack([uniform_numbers(names, k) for k in range(3 * count + 1)], axis=1)
    lengths = drawn[:, 1:].reshape(len(names), count, 3)
    # The lengths between three points of an interval, in their order, are evenly distributed.
    lengths.sort(axis=2)
    lengths = np.diff(lengths, axis=2, prepend=0.0, append=1.0)
    return spread_over_eighths(lengths, (8.0 * drawn[:, 0]).astype(np.int64))


def spread_over_eighths(weights: npt.NDArray[np.floating], first: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """Barycentric coordinates in tetrahedra, of points with these coordinates in their eighths, float64 [n, count, 4].

    Args:
        weights: Coordinates of points in one eighth each [n, count, 4].
        first: The number of the eighth of the first point in each tetrahedron [n].
    """
    count = weights.shape[1]
    eighths = first[:, None] + np.arange(count) * max(8 // count, 1)
    return combined(weights, _EIGHTHS[eighths % 8])


def combined(weights: npt.NDArray[np.floating], corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The sums of corners [..., 4, k] with weights [..., 4], added in their order, float64 [..., k]."""
    found = np.zeros(np.broadcast_shapes(weights.shape, corners.shape[:-1])[:-1] + corners.shape[-1:])
    for n in range(4):
        found += weights[..., n, None] * corners[..., n, :]
    return found


#: Corners of the eight tetrahedra of one size that a tetrahedron is made of, as barycentric coordinates [8, 4, 4].
_ENDS = {n: np.eye(4)[n] for n in range(4)}
_MIDDLES = {(i, j): 0.5 * (np.eye(4)[i] + np.eye(4)[j]) for i in range(4) for j in range(4) if i != j}
_EIGHTHS = np.array(
    [[_ENDS[n], *(_MIDDLES[n, m] for m in range(4) if m != n)] for n in range(4)]
    + [
        [_MIDDLES[0, 2], _MIDDLES[1, 3], _MIDDLES[a], _MIDDLES[b]]
        for a, b in (((0, 1), (1, 2)), ((1, 2), (2, 3)), ((2, 3), (0, 3)), ((0, 3), (0, 1)))
    ]
)
