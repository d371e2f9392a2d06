"""Organs and a few small worlds on CUDA: many steps in a launch, one thread block for each patch; see
``kernels.stepping.patches``."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.body.trajectory import Followed
from warp_corot.elasticity.corotated.fields import CorotatedGeneralField, SubtreeField
from warp_corot.elasticity.dilatation import law_of
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.stepping.patch_body import Exchange, Layout, PatchBody
from warp_corot.kernels.stepping.patches import step_patches
from warp_corot.materials.anisotropic import Directional

from .patch_layout import NO_SLOT, Patches

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField
    from warp_corot.elasticity.corotated.fields import CorotatedField
    from warp_corot.solvers.system import System

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
            step_patches(self.layout, body.conditions.loads.dtype),
            dim=body.worlds * self.patches.count * self.layout.threads,
            block_dim=self.layout.threads,
            inputs=[
                self._tables,
                count,
                damping,
                system.gravity,
                body.discretization.mu,
                body.discretization.lam,
                body.discretization.material_stride,
                body.conditions.mass,
                body.conditions.inverse_mass,
                int(body.conditions.has_loads),
                body.conditions.loads,
                system.pace.arrays,
                body.conditions.world_starts,
                self._exchange,
                body.state.displacements,
                body.state.velocities,
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
    if not isinstance(field, (SubtreeField, CorotatedGeneralField)):
        return False
    of_model: CorotatedField = field
    model = of_model.model
    return model.rotation_level is None and model.own_rotation is quick_rotation


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
