"""Steps of a body in one launch of resident blocks, and the division of the mesh into patches for them.

Plain NumPy. A patch owns its nodes and computes every element with a corner there, so that it needs no forces from
other patches; each patch computes the elements between patches for itself. In every step a patch needs only the
positions of its halo, the other corners of its elements.

Where elements share their dilatation in groups, a patch measures all elements of each group of which it computes one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.body.keyframes import Followed
from warp_corot.elasticity.corotated.fields import SubtreeField
from warp_corot.elasticity.dilatation import law_of
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.stepping.patches import Exchange, Layout, PatchBody, step_patches
from warp_corot.materials.anisotropic import Directional

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField
    from warp_corot.solvers.system import System


WARP = 32

#: The slot number of corners that another patch owns.
NO_SLOT = 0xFFFF

#: The most threads that add up one node: a node has two dozen elements.
MOST_LANES = 8


@dataclass(frozen=True, eq=False)
class Patches:
    """The nodes and elements of each patch; ``*_start`` arrays say where each patch's part begins, int32 [patches + 1].

    Within a patch, nodes are numbered from 0: first its own, those with the most elements first, then its halo.
    ``lanes`` neighbouring threads add up each own node. The slots that the 32 threads of a warp read at once lie side
    by side: slot ``base + 32 row + thread``. A warp has as many rows as its busiest thread needs; unused places stay
    zero.

    Attributes:
        lanes: Threads that add up one node: 1, 2, 4, 8, 16 or 32.
        own, own_start: Nodes that patches own, int32 [N].
        halo, halo_start: Nodes of other patches that patches read, int32 [H].
        elements, element_start: Elements of patches: those without halo, then the others that they compute, then those
            that they only measure; int32 [E].
        interior: Number of elements of each patch without a corner in the halo, int32 [patches].
        computed: Number of elements that each patch computes, int32 [patches].
        corners: The four nodes of each element, numbered in the patch, int32 [E, 4].
        slots: The slot of each corner's force; ``NO_SLOT`` at corners of the halo; int32 [E, 4].
        bases, base_start: Where each warp's slots begin, and after a patch's last warp the number of its slots, int32.
        groups: The group of each element, numbered in the patch, int32 [E]; zero where there are no groups.
        ranks: Its place in that group, int32 [E].
        group_counts: Number of groups of each patch, int32 [patches].
    """

    lanes: int
    own: np.ndarray
    own_start: np.ndarray
    halo: np.ndarray
    halo_start: np.ndarray
    elements: np.ndarray
    element_start: np.ndarray
    interior: np.ndarray
    computed: np.ndarray
    corners: np.ndarray
    slots: np.ndarray
    bases: np.ndarray
    base_start: np.ndarray
    groups: np.ndarray
    ranks: np.ndarray
    group_counts: np.ndarray

    @classmethod
    def of(
        cls, points: np.ndarray, tets: np.ndarray, count: int, threads: int, groups: np.ndarray | None = None
    ) -> Patches:
        """Patches with about equal numbers of corners.

        Args:
            points: Rest positions, float64 [N, 3].
            tets: int32 [T, 4].
            count: Number of patches, at most the number of nodes.
            threads: Threads of a block; they determine how many add up one node.
            groups: The group of each element, int [T]; None: there are none.
        """
        n = len(points)
        valence = np.bincount(tets.ravel(), minlength=n)
        owner = patch_of_nodes(points, valence + 1, count)
        own = np.lexsort((np.arange(n), -valence, owner))
        own_start = _starts(np.bincount(owner, minlength=count))
        lanes = MOST_LANES
        while lanes > 1 and lanes * np.diff(own_start).max() > threads:
            lanes //= 2
        place = np.empty(n, np.int64)
        place[own] = np.arange(n)
        place -= own_start[owner]

        patch, element, element_start, interior, computed = _elements_by_patch(owner[tets], count, groups)
        nodes = tets[element]
        foreign = owner[nodes] != patch[:, None]
        halo, inverse = np.unique((patch[:, None] * n + nodes)[foreign], return_inverse=True)
        halo_start = _starts(np.bincount(halo // n, minlength=count))
        corners = place[nodes]
        of_halo = np.repeat(patch, foreign.sum(axis=1))
        corners[foreign] = inverse - halo_start[of_halo] + np.diff(own_start)[of_halo]

        bases, base_start = _slot_bases(valence[own], own_start, lanes)
        slots = np.full(nodes.shape, NO_SLOT)
        mine = nodes[~foreign]
        rank = _rank(mine, valence)
        thread = place[mine] * lanes + rank % lanes
        warp = base_start[owner[mine]] + thread // WARP
        slots[~foreign] = bases[warp] + rank // lanes * WARP + thread % WARP
        arrays = (
            own,
            own_start,
            halo % n,
            halo_start,
            element,
            element_start,
            interior,
            computed,
            corners,
            slots,
            bases,
            base_start,
            *_groups_by_patch(patch, element, groups, count),
        )
        return cls(lanes, *(array.astype(np.int32) for array in arrays))

    @property
    def count(self) -> int:
        return len(self.own_start) - 1

    @property
    def most_own(self) -> int:
        """The most own nodes of a patch."""
        return int(np.diff(self.own_start).max())

    @property
    def most_halo(self) -> int:
        """The most nodes of a halo."""
        return int(np.diff(self.halo_start).max())

    @property
    def most_nodes(self) -> int:
        """The most nodes of a patch, its own and its halo's."""
        return int((np.diff(self.own_start) + np.diff(self.halo_start)).max())

    @property
    def most_slots(self) -> int:
        """The most slots of a patch."""
        return int(self.bases[self.base_start[1:] - 1].max())

    @property
    def most_groups(self) -> int:
        """The most groups of a patch."""
        return int(self.group_counts.max())

    @property
    def most_members(self) -> int:
        """The most elements of a group; zero where there are no groups."""
        return int(self.ranks.max()) + 1 if self.most_groups else 0

    @property
    def most_computed(self) -> int:
        """The most elements that a patch computes."""
        return int(self.computed.max())

    @property
    def most_elements(self) -> int:
        """The most elements of a patch."""
        return int(np.diff(self.element_start).max())


def patch_of_nodes(points: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Split points across the longest extent, and the parts again, into patches of about equal weight: int64 [N]."""
    patch = np.zeros(len(points), np.int64)
    waiting = [(np.arange(len(points)), 0, count)]
    while waiting:
        chosen, first, parts = waiting.pop()
        if parts == 1:
            patch[chosen] = first
            continue
        x = points[chosen]
        axes = np.argsort(-np.ptp(x, axis=0))
        # Points in one plane are ordered by the other axes; lattices have many such points.
        chosen = chosen[np.lexsort(x[:, axes[::-1]].T)]
        left = parts // 2
        share = np.cumsum(weight[chosen]) / weight[chosen].sum()
        cut = int(np.searchsorted(share, left / parts, side="right"))
        cut = min(max(cut, left), len(chosen) - (parts - left))
        waiting += [(chosen[:cut], first, left), (chosen[cut:], first + left, parts - left)]
    return patch


def _elements_by_patch(
    owners: np.ndarray, count: int, groups: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of a patch and an element, patch by patch, in the order of ``Patches.elements``: both [E]; where each patch
    begins, how many inner elements it has, and how many it computes.

    Args:
        owners: The patches of the elements' nodes, [T, 4].
        count: Number of patches.
        groups: As for ``Patches.of``.
    """
    new = np.ones(owners.shape, bool)
    for k in range(1, 4):
        for earlier in range(k):
            new[:, k] &= owners[:, k] != owners[:, earlier]
    element, corner = np.nonzero(new)
    patch = owners[element, corner]
    kind = (new.sum(axis=1) > 1)[element].astype(np.int64)
    if groups is not None:
        others = _other_members(patch, element, groups)
        patch, element = (np.concatenate(pair) for pair in zip((patch, element), others, strict=True))
        kind = np.concatenate([kind, np.full(len(others[0]), 2)])
    order = np.lexsort((element, kind, patch))
    interior, computed = (np.bincount(patch[kind <= most], minlength=count) for most in (0, 1))
    return patch[order], element[order], _starts(np.bincount(patch, minlength=count)), interior, computed


def _other_members(patch: np.ndarray, element: np.ndarray, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The elements in the groups of each patch's elements that are not among these, and their patches."""
    order = np.argsort(groups, kind="stable")
    sizes = np.bincount(groups)
    first = _starts(sizes)
    pairs = np.unique(patch * len(sizes) + groups[element])
    of_patch, group = np.divmod(pairs, len(sizes))
    size = sizes[group]
    at = np.repeat(first[group] - _starts(size)[:-1], size) + np.arange(size.sum())
    member, its_patch = order[at], np.repeat(of_patch, size)
    is_new = ~np.isin(its_patch * len(groups) + member, patch * len(groups) + element)
    return its_patch[is_new], member[is_new]


def _groups_by_patch(
    patch: np.ndarray, element: np.ndarray, groups: np.ndarray | None, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``groups``, ``ranks`` and ``group_counts`` of pairs of a patch and an element; ranks in the elements' order."""
    if groups is None:
        return np.zeros(len(element)), np.zeros(len(element)), np.zeros(count)
    pairs, of_pair = np.unique(patch * (groups.max() + 1) + groups[element], return_inverse=True)
    counts = np.bincount(pairs // (groups.max() + 1), minlength=count)
    order = np.lexsort((element, of_pair))
    ranks = np.empty(len(element), np.int64)
    ranks[order] = np.arange(len(element)) - _starts(np.bincount(of_pair))[of_pair[order]]
    return of_pair - _starts(counts)[patch], ranks, counts


def _slot_bases(valence: np.ndarray, own_start: np.ndarray, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """``bases`` and ``base_start``.

    Args:
        valence: Elements of each node, in the order of ``own``; they decrease within a patch.
    """
    each = WARP // lanes
    own = np.diff(own_start)
    warps = -(-own // each)
    base_start = _starts(warps + 1)
    bases = np.zeros(base_start[-1], np.int64)
    for patch in range(len(own)):
        busiest = valence[own_start[patch] : own_start[patch + 1] : each]
        rows = -(-busiest // lanes)
        bases[base_start[patch] + 1 : base_start[patch + 1]] = np.cumsum(rows) * WARP
    return bases, base_start


def _rank(nodes: np.ndarray, valence: np.ndarray) -> np.ndarray:
    """For each entry of a list of nodes, how often the same node came before."""
    order = np.argsort(nodes, kind="stable")
    start = _starts(valence)
    rank = np.empty(len(nodes), np.int64)
    rank[order] = np.arange(len(nodes)) - start[nodes[order]]
    return rank


def _starts(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])


#: Elements of a world that becomes faster: smaller ones need few blocks, and patches of larger ones do not fit.
FEWEST, MOST = 500, 150_000
#: Minimum number of elements in a patch: with fewer, the blocks of small bodies mostly wait for each other.
PATCH_ELEMENTS = 32
#: Minimum number of multiprocessors for each world: with fewer, one block for each world is faster.
FEWEST_BLOCKS = 4
#: Threads of a block, each for patches that compute at most this many elements; more threads have fewer registers.
THREADS = ((256, 512), (512, 1024), (384, 1536), (512, 2048))
#: Number of elements that a thread measures if there are enough threads, and the maximum.
SOON_MEASURED, MOST_MEASURED = 3, 8
#: Largest number of elements whose constants a thread keeps in registers, and of halo nodes that it waits for.
MOST_ELEMENTS, MOST_HALO = 4, 3
#: The first architecture whose reads and writes of 16 bytes are atomic.
LEAST_ARCH = 70
#: Bytes of a block's shared memory that Warp reserves for its tiles.
TILE_BYTES = 8192
#: Room in kernels is a multiple of this, so that bodies share kernels.
NODE_ROOM, SLOT_ROOM, GROUP_ROOM, MEMBER_ROOM = 128, 512, 64, 4


class PatchSteps:
    """Symplectic Euler steps of a body whose patches are all resident on the GPU at once.

    ``of`` makes it if that is possible.
    """

    def __init__(self, body: SoftBody, patches: Patches, layout: Layout):
        self.body = body
        self.patches = patches
        self.layout = layout
        device = body.device
        self._tables = _device_patches(body, patches, layout)
        self._exchange = Exchange()
        self._exchange.nodes = body.node_count
        self._exchange.published = wp.zeros(2 * body.node_count, dtype=wp.vec4, device=device)
        self._exchange.begun = wp.array(np.ones(body.worlds * patches.count), dtype=wp.uint32, device=device)
        self._trajectories: list[Followed] | None = None
        self.prepare()

    @classmethod
    def of(
        cls, body: SoftBody, field: ForceField, *, count: int | None = None, threads: int | None = None
    ) -> PatchSteps | None:
        """A body's steps by patches; None if it is not on CUDA, is too small or large, has too many worlds, or has
        another model than the corotated one with own rotations.

        Args:
            count: Patches of a world; those of all worlds are at most as many as multiprocessors; None: as many as may
                be, or fewer for small bodies.
            threads: Threads of a block; None: chosen by its elements.
        """
        law, sharing = law_of(field)
        if not _suits(body, law):
            return None
        elements, resident = len(body.mesh.tets), body.device.sm_count // body.worlds
        if resident < FEWEST_BLOCKS:
            return None
        groups = None if sharing is None else sharing.group_numbers()[:elements]
        count = min(count or max(elements // PATCH_ELEMENTS, 1), resident)
        if elements > count * THREADS[-1][1]:
            return None
        room = body.device.max_shared_memory_per_block - TILE_BYTES
        sizes = THREADS if threads is None else ((threads, MOST_ELEMENTS * threads),)
        measured = (MOST_MEASURED,) if groups is None else (SOON_MEASURED, MOST_MEASURED)
        patches: Patches | None = None
        for at_once, (each, most) in itertools.product(measured, sizes):
            # Numbers of elements do not depend on the threads.
            if patches and (patches.most_computed > most or patches.most_elements > at_once * each):
                continue
            patches = Patches.of(body.mesh.points, body.mesh.tets, count, each, groups)
            if patches.most_computed > most or patches.most_elements > at_once * each:
                continue
            layout = layout_of(patches, each, room)
            if layout is not None:
                return cls(body, patches, layout)
        return None

    def prepare(self) -> None:
        """Copy the body's keyframes to the device if they have changed; not while launches are recorded."""
        before, now = self._trajectories, list(self.body.conditions.trajectories)
        if now == before:
            return
        self._trajectories = now
        if (
            before is not None
            and len(now) == len(before)
            and all(a.times is b.times for a, b in zip(now, before, strict=True))
        ):
            _rewrite_keyframes(self._tables, now)  # others in the same arrays
        else:
            _set_keyframes(self._tables, now, self.body)

    @property
    def is_prepared(self) -> bool:
        """Whether the keyframes on the device are the body's; they are not if they changed during a recording."""
        return self._trajectories == self.body.conditions.trajectories

    def launch(self, count: int, damping: float, system: System) -> None:
        """Launch ``count`` steps, the first ones since the clock was last advanced."""
        body = self.body
        wp.launch(
            step_patches(self.layout),
            dim=body.worlds * self.patches.count * self.layout.threads,
            block_dim=self.layout.threads,
            inputs=[
                self._tables,
                count,
                system.dynamics(body, damping),
                body.discretization.mu,
                body.discretization.lam,
                body.discretization.material_stride,
                body.conditions.mass,
                system.pace.arrays,
                body.conditions.world_starts,
                self._exchange,
            ],
            outputs=[body.state.reactions, system.support_work, system.bad_step],
            device=body.device,
        )


def layout_of(patches: Patches, threads: int, most_bytes: int) -> Layout | None:
    """The layout for which the kernel is generated; None if the patches do not fit into the memory of a block."""
    elements = -(-patches.most_computed // threads)
    halo = max(-(-patches.most_halo // threads), 1)
    nodes = -(-patches.most_nodes // NODE_ROOM) * NODE_ROOM
    slots = -(-(patches.most_slots + 1) // SLOT_ROOM) * SLOT_ROOM - 1
    groups = -(-patches.most_groups // GROUP_ROOM) * GROUP_ROOM
    members = -(-patches.most_members // MEMBER_ROOM) * MEMBER_ROOM
    layout = Layout(threads, elements, halo, patches.lanes, nodes, slots, groups, members)
    fits = groups <= threads and 4 * layout.floats <= most_bytes and patches.most_own * patches.lanes <= threads
    return layout if fits and elements <= MOST_ELEMENTS and halo <= MOST_HALO else None


def _suits(body: SoftBody, field: ForceField) -> bool:
    if body.changing is not None or not body.device.is_cuda or body.device.arch < LEAST_ARCH:
        return False
    if isinstance(body.material, Directional) or field.deterministic:
        return False
    return FEWEST <= len(body.mesh.tets) <= MOST and _has_own_rotations(field)


def _has_own_rotations(field: ForceField) -> bool:
    """Whether the model is the corotated one on a fast path, with a rotation of each element."""
    return (
        isinstance(field, SubtreeField)
        and field.model.rotation_level is None
        and field.model.own_rotation is quick_rotation
    )


def _device_patches(body: SoftBody, patches: Patches, layout: Layout) -> PatchBody:
    """The patches as the kernel reads them, without keyframes."""
    device = body.device
    tables = PatchBody()
    tables.element_count = len(body.mesh.tets)
    for name in (
        "own",
        "own_start",
        "halo",
        "halo_start",
        "elements",
        "element_start",
        "interior",
        "computed",
        "bases",
        "base_start",
    ):
        setattr(tables, name, wp.array(getattr(patches, name), dtype=wp.int32, device=device))
    slots = np.where(patches.slots == NO_SLOT, layout.slots, patches.slots)
    tables.corners = wp.array(_packed(patches.corners), dtype=wp.uint64, device=device)
    tables.slots = wp.array(_packed(slots), dtype=wp.uint64, device=device)
    measures = patches.ranks * layout.groups + patches.groups
    tables.measures = wp.array(measures, dtype=wp.int32, device=device)
    rest = np.ascontiguousarray(rest_rows(body.mesh.points, body.mesh.tets)[:, patches.elements])
    tables.rest = wp.array(rest, dtype=wp.float32, device=device)
    return tables


def rest_rows(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """The inverse rest edges, row by row, and the volumes of elements of either orientation: float32 [10, T]."""
    x = points[tets]
    edges = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
    inverse = np.linalg.inv(edges).reshape(-1, 9)
    volume = np.abs(np.linalg.det(edges)) / 6.0
    return np.column_stack([inverse, volume]).T.astype(np.float32)


def _packed(places: np.ndarray) -> np.ndarray:
    """Four 16-bit numbers in a word, uint64 [E]."""
    return np.ascontiguousarray(places.astype("<u2")).view("<u8").ravel()


def _set_keyframes(tables: PatchBody, trajectories: Sequence[Followed], body: SoftBody) -> None:
    """Put the keyframes of all trajectories one after another; a node follows the last one that names it."""
    follows, place = np.full(body.node_count, -1), np.zeros(body.node_count)
    times, values, columns = [np.zeros(0)], [np.zeros((0, 3))], []
    for k, trajectory in enumerate(trajectories):
        nodes, d = trajectory.host_numbers, trajectory.values.numpy()
        follows[nodes], place[nodes] = k, np.arange(len(nodes))
        times.append(trajectory.times.numpy())
        values.append(d.reshape(-1, 3))
        columns.append(d.shape[1])
    starts = np.cumsum([len(part) for part in times]), np.cumsum([len(part) for part in values])[:-1]
    for name, numbers in (
        ("trajectory", follows),
        ("place", place),
        ("key_start", starts[0]),
        ("value_start", starts[1]),
        ("columns", columns),
    ):
        setattr(tables, name, wp.array(np.asarray(numbers), dtype=wp.int32, device=body.device))
    tables.times = wp.array(np.concatenate(times), dtype=wp.float64, device=body.device)
    tables.values = wp.array(np.concatenate(values), dtype=wp.vec3, device=body.device)


def _rewrite_keyframes(tables: PatchBody, trajectories: Sequence[Followed]) -> None:
    """Copy times and displacements of trajectories whose nodes and numbers of keyframes have not changed."""
    key = value = 0
    for trajectory in trajectories:
        displacements = trajectory.values.flatten()
        wp.copy(tables.times, trajectory.times, dest_offset=key)
        wp.copy(tables.values, displacements, dest_offset=value)
        key, value = key + len(trajectory.times), value + len(displacements)
