"""Force plans of a forest in NumPy, which the planner's launches must equal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_corot.discretization.elements import frame_keys, frame_table, in_worlds
from warp_corot.discretization.plan import Sharing
from warp_corot.discretization.planner import subtree_nodes
from warp_corot.kernels.tables.subtree import GROUP_NODES, group_nodes

SUBTREE_LEVELS = 3
GROUP_LEVELS = 6


def shape_codes(lattice, tets, level):
    """Codes of elements, int32 [n], and a table of just the frames that these have, float64 [n_frames, 3, 3]."""
    key = frame_keys(lattice, tets, level)
    bits, frames = frame_table(np.unique(key))
    return bits[key] | level, frames


def complete_subtrees(forest, depth):
    """First leaves of the subtrees whose 2**depth leaves all lie ``depth`` levels below their root; in tree order."""
    size = 2**depth
    ancestor = forest.tree.above(forest.tree.leaves, depth)
    # In tree order the leaves at one depth below an ancestor follow one another unless deeper ones come between.
    change = np.flatnonzero(np.diff(ancestor, prepend=-2))
    length = np.diff(change, append=len(ancestor))
    return change[(length == size) & (ancestor[change] >= 0)].astype(np.int32)


class OracleUnits:
    """The highest tetrahedra that are not above a level, each once: their nodes and levels, and each leaf's."""

    def __init__(self, forest, rotation_level, worlds=1):
        ancestors, unit = np.unique(forest.ancestors(rotation_level), return_inverse=True)
        tets, level = forest.tree.rows(ancestors)
        self.nodes = in_worlds(tets, worlds, len(forest.points))
        self.codes, self.frames = shape_codes(forest.lattice, tets, level)
        self.codes = np.tile(self.codes, worlds)
        self.unit = in_worlds(unit.ravel().astype(np.int32), worlds, len(ancestors))
        self.count = worlds * len(ancestors)


@dataclass
class OracleBatch:
    """Subtrees of one shape and sharing: first leaves, nodes by unit of work, and codes of roots."""

    shape: int
    grouped: bool
    sharing: Sharing
    first: np.ndarray
    nodes: np.ndarray
    codes: np.ndarray
    frames: np.ndarray

    @property
    def count(self):
        return len(self.first)


class OraclePlan:
    """What ``planner.ForcePlan`` must be.

    Attributes:
        batches: ``OracleBatch``es.
        flat: The other leaves, int32.
        units: ``OracleUnits`` if a batch or a single leaf needs them, else None.
    """

    def __init__(self, forest, rotation_level=None, *, worlds=1, grouped=False):
        self.forest, self.worlds = forest, worlds
        members, flat = in_batches(forest, rotation_level, grouped)
        count, nodes = len(forest.tets), len(forest.points)
        of_nodes = [self._of_leaves(member, forest.tets) for member in members]
        self.batches = []
        for (shape, kind, sharing, first), own in zip(members, of_nodes, strict=True):
            roots, level = forest.tree.rows(forest.tree.above(forest.tree.leaves[first], SUBTREE_LEVELS))
            codes, frames = shape_codes(forest.lattice, roots, level)
            self.batches.append(
                OracleBatch(
                    shape,
                    kind,
                    sharing,
                    in_worlds(first, worlds, count),
                    in_worlds(own, worlds, nodes),
                    np.tile(codes, worlds),
                    frames,
                )
            )
        self.flat = in_worlds(flat, worlds, count)
        self.flat_nodes = in_worlds(forest.tets[flat], worlds, nodes)
        shared = rotation_level is not None
        above = any(batch.sharing is Sharing.ABOVE for batch in self.batches)
        self.units = OracleUnits(forest, rotation_level, worlds) if shared and (above or len(flat)) else None

    def _of_leaves(self, member, values):
        """What leaves have at their nodes, int32 [T, 4], by the nodes of the units of work: [units, 40 or 10]."""
        shape, grouped, _, first = member
        if not grouped:
            places = np.array(subtree_nodes(shape))
            return values[first[:, None] + places[:, 0], places[:, 1]]
        places = np.array(group_nodes(shape))
        found = np.full((len(first) // 8, GROUP_NODES), -1, np.int32)
        found[:, : len(places)] = values[first[::8, None] + places[:, 0], places[:, 1]]
        return found


def in_batches(forest, rotation_level, grouped):
    """Shape, whether grouped, sharing and first leaves of the batches; and the leaves that are in none."""
    first = complete_subtrees(forest, SUBTREE_LEVELS)
    level = forest.levels[first]
    root = level - SUBTREE_LEVELS
    if rotation_level is None:
        shares = {Sharing.OWN: np.ones(len(first), bool)}
    else:
        # Between root and leaves, leaves of one subtree use different rotations: those go leaf by leaf.
        shares = {
            Sharing.OWN: level <= rotation_level,
            Sharing.ROOT: root == rotation_level,
            Sharing.ABOVE: root > rotation_level,
        }
    in_group = np.zeros(len(first), bool)
    if grouped:
        at = np.searchsorted(first, complete_subtrees(forest, GROUP_LEVELS))
        in_group[(at[:, None] + np.arange(8)).ravel()] = True
    members = []
    left = np.ones(len(forest.tets), bool)
    for sharing, mask in shares.items():
        for shape in range(3):
            for kind in (True, False):
                found = first[mask & (level % 3 == shape) & (in_group == kind)]
                if len(found):
                    members.append((shape, kind, sharing, found))
                    left[(found[:, None] + np.arange(8)).ravel()] = False
    return members, np.flatnonzero(left).astype(np.int32)
