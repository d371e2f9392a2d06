"""Edges of triangles, found by sorting, against a dictionary of edges."""

from collections import defaultdict

import numpy as np
import pytest

from warp_corot.domain.closing import Edges
from warp_corot.mesh.topology import FEW, sorted_keys


def soup(seed: int) -> np.ndarray:
    """Triangles between few points, so that edges have from one to many of them."""
    rng = np.random.default_rng(seed)
    return np.array([rng.choice(9, 3, replace=False) for _ in range(25)])


@pytest.mark.parametrize("seed", range(3))
def test_edges_know_their_half_edges(seed):
    triangles = soup(seed)
    sharers, ways = defaultdict(list), defaultdict(int)
    for half in range(3 * len(triangles)):
        t, k = divmod(half, 3)
        a, b = int(triangles[t, k]), int(triangles[t, (k + 1) % 3])
        sharers[min(a, b), max(a, b)].append(half)
        ways[min(a, b), max(a, b)] += 1 if a < b else -1
    edges = Edges(triangles)
    assert [tuple(ends) for ends in edges.ends.tolist()] == sorted(sharers)
    found = np.split(edges.order, edges.starts[1:])
    assert [half.tolist() for half in found] == [sharers[ends] for ends in sorted(sharers)]
    chains = [(a, b) for ends in sorted(sharers) for a, b in zip(sharers[ends][:-1], sharers[ends][1:], strict=True)]
    assert list(zip(*(part.tolist() for part in edges.pairs), strict=True)) == chains
    twos = [tuple(sharers[ends]) for ends in sorted(sharers) if len(sharers[ends]) == 2]
    assert list(zip(*(part.tolist() for part in edges.twos), strict=True)) == twos
    boundary, often = edges.net()
    walked = {(a, b) if n > 0 else (b, a): abs(n) for (a, b), n in ways.items() if n}
    assert dict(zip(map(tuple, boundary.tolist()), often.tolist(), strict=True)) == walked


@pytest.mark.parametrize(("count", "limit"), [(1000, 50), (1000, 2**62), (FEW + 1, 2**20), (FEW + 1, 2**63)])
def test_keys_are_sorted_and_equal_ones_keep_their_order(count, limit):
    rng = np.random.default_rng(0)
    keys = rng.integers(0, limit, count, dtype=np.int64)
    keys[::3] = keys[0]
    ordered, places = sorted_keys(keys, limit)
    order = np.argsort(keys, kind="stable")
    assert np.array_equal(places, order)
    assert np.array_equal(ordered, keys[order])
