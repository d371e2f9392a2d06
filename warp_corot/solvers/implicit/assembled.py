"""Linear solves with the matrix of all bodies assembled, each in one launch; see ``kernels.implicit.assembled``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity.corotated.fields import CorotatedField
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.inputs.cpu_threads import Regions
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.implicit import assembled as kernels
from warp_corot.kernels.implicit.multigrid import values
from warp_corot.kernels.implicit.multigrid.cycle import Rows
from warp_corot.materials.anisotropic import Directional

from .multigrid.level import LeafMatrix
from .multigrid.pattern import Pattern, PatternFinder
from .tangent import TangentOperator

if TYPE_CHECKING:
    from .block_system import VectorBlocks
    from .conjugate_gradients import ConjugateGradients
    from .operator import Contact


Numbers = npt.NDArray[np.integer]

#: A row takes as long as so many entries besides its own.
PER_ROW = 6
#: So few rows are left to one thread.
FEW = 64


def dissected(points: npt.NDArray[np.float64], starts: Numbers, columns: Numbers, parts: int) -> list[Numbers]:
    """The nodes of each level and part: no node of a level is coupled with one in another part of it, and the parts of
    a level take about equally long.

    A level is cut in halves, and these again, by coordinates; what separates two halves goes on to the next level.

    Args:
        points: Positions of the nodes, [N, 3].
        starts, columns: The entries of each row, [N + 1] and [entries].
        parts: Number of parts.

    Returns:
        The nodes of the parts of the first level, then those of the next one, and so on.
    """
    counts = np.diff(starts)
    weight, side = counts + PER_ROW, np.zeros(len(points), np.int8)
    edges = np.stack([np.repeat(np.arange(len(points)), counts), columns[: starts[-1]]])
    found, left = [], np.arange(len(points))
    while len(left) > FEW:
        level: list[Numbers] = [left[:0]] * parts
        between, waiting = [left[:0]], [(left, edges, 0, parts)]
        while waiting:
            nodes, own, first, share = waiting.pop()
            if share == 1 or not len(nodes):
                level[first] = np.sort(nodes)
                continue
            axes = np.argsort(-np.ptp(points[nodes], axis=0))
            # Points in one plane are ordered by the other axes; lattices have many such points.
            nodes = nodes[np.lexsort(points[nodes][:, axes[::-1]].T)]
            before, separating = np.cumsum(weight[nodes]), 0
            for _ in range(3):  # the halves are as large without what separates them, which is in the second one
                cut = int(np.searchsorted(before, (before[-1] - separating) * (share // 2) / share))
                side[nodes[:cut]], side[nodes[cut:]] = 1, 2
                ends = side[own]
                meets = own[1, (ends[0] == 1) & (ends[1] == 2)]
                side[meets] = 3
                separating = int(weight[nodes[side[nodes] == 3]].sum())
            ends = side[own]
            between.append(nodes[side[nodes] == 3])
            for half, begin, number in ((1, first, share // 2), (2, first + share // 2, share - share // 2)):
                waiting.append((nodes[side[nodes] == half], own[:, (ends == half).all(axis=0)], begin, number))
        found += level
        left = np.concatenate(between)
        side[:], side[left] = 0, 1
        edges = edges[:, side[edges].all(axis=0)]
    return [*found, left, *[left[:0]] * (parts - 1)] if len(left) else found


#: Threads of a block on CUDA, and the lanes that share a row: as many as leave no thread idle, within these bounds.
THREADS, FEWEST_LANES, MOST_LANES = 512, 4, 16
#: Numbers between the barriers of two teams of blocks, so that these lie in lines of their own.
STRIDE = 32
#: Room for the products that contacts add: so many a node, and at least this many; on the CPU so many times as much for
#: their entries.
ROOM, LEAST_ROOM, ENTRIES = 2, 4096, 8


def suits(operator: TangentOperator) -> bool:
    """Whether an operator's matrix can be assembled: corotated elements of a forest, each with its own rotation."""
    field = operator.field.shear if isinstance(operator.field, DilatationField) else operator.field
    return (
        isinstance(field, CorotatedField)
        and field.model.rotation_level is None
        and operator.body.discretization.element_kind is ForestElements
        and not isinstance(operator.body.material, Directional)
        and operator.viscosity is None
        and operator.ranks.is_alone
        and all(getattr(forces, "is_diagonal", False) for forces in operator.stiff_forces)
    )


@dataclass(frozen=True, eq=False)
class _BodyMatrix:
    """What the matrix of one body is computed from."""

    operator: TangentOperator
    leaves: LeafMatrix
    nodes: wp.array  # by row
    free: wp.array
    edges: np.ndarray  # where the rows of each level and thread begin

    @property
    def pattern(self) -> Pattern:
        return self.leaves.pattern


class AssembledSolve:
    """The matrices of operators as one, and conjugate gradients with it in one launch.

    On the CPU threads share the worlds or the rows of each, with a symmetric sweep over the rows as preconditioner
    (SSOR); on CUDA resident blocks solve a world, with the inverses of diagonal blocks.

    Args:
        operators: Operators that ``suit``, of bodies whose vectors are the ``blocks`` of one.
        blocks: These blocks.
        together: Whether all bodies and worlds are one world of the matrix; otherwise there is one body.
        touches: Whether there may be contacts.

    Attributes:
        blocks, touches: As given.
        diagonal: The blocks on the diagonal without contacts, mat33 [entries of vectors + 1].
        couplings: The contacts of the present solve.
    """

    def __init__(self, operators: Sequence[TangentOperator], blocks: VectorBlocks, *, together: bool, touches: bool):
        self._operators, self.blocks, self._together, self.touches = list(operators), blocks, together, touches
        self.device, self._versions = operators[0].device, [-1]
        teams = [operator.body.discretization.team for operator in operators]
        self._regions = Regions(max(teams, key=lambda team: team.parts), self.device)
        self.follow()

    def follow(self) -> None:
        """Follow the meshes, if they have changed; not while launches are recorded. Waits for the device."""
        device = self.device
        versions = [operator.body.discretization.sizes.version for operator in self._operators]
        if self._versions == versions:
            return
        self._versions = versions
        nodes = self.blocks.count
        self._worlds, self._count = 1, nodes
        if not self._together:
            (operator,) = self._operators
            self._worlds, self._count = operator.worlds, operator.node_count
        self._bodies = [self._body_matrix(operator, self.threads) for operator in self._operators]
        self._find_rows(self.threads)
        # One more, since products read past the last.
        self.diagonal, self._inverses, pivots = (wp.zeros(nodes + 1, dtype=wp.mat33, device=device) for _ in range(3))
        self._rows.blocks = wp.zeros(self._worlds * self._entries + 1, dtype=wp.mat33, device=device)
        planes = 9 * self._worlds * self._entries if device.is_cuda else 1
        self._planes = wp.zeros(planes, dtype=wp.float32, device=device)
        data = self._data = kernels.Solve()
        data.worlds, data.count, data.entries, data.rows = self._worlds, self._count, self._entries, self._rows
        data.planes, data.inverses, data.pivots = self._planes, self._inverses, pivots
        data.u, data.p, data.q, data.s, data.added = (wp.zeros(nodes, dtype=wp.vec4, device=device) for _ in range(5))
        data.diagonal, data.division, data.team = self._diagonal, self._division, self._regions.team.address
        self._make_couplings(nodes)
        data.couplings, data.of_contacts = self.couplings, self._of_contacts
        self._find_launch(data)

    def _body_matrix(self, operator: TangentOperator, parts: int) -> _BodyMatrix:
        count, device, discretization = operator.node_count, self.device, operator.body.discretization
        members = operator.field.find_members
        free = wp.zeros(count * operator.worlds, dtype=wp.uint8, device=device)
        finder = PatternFinder(wp.zeros(count, dtype=wp.vec2i, device=device))
        groups = None if members is None else members(discretization.sizes.world_elements)

        def matrix(rows: list[np.ndarray]) -> _BodyMatrix:
            order = np.concatenate(rows)
            nodes, rank = (wp.array(each, dtype=wp.int32, device=device) for each in (order, np.argsort(order)))
            leaves = LeafMatrix(discretization, finder, nodes, rank, count, free, groups)
            return _BodyMatrix(operator, leaves, nodes, free, np.cumsum([0, *map(len, rows)]))

        found = matrix([np.arange(count)])
        if parts == 1:
            return found
        starts, columns = found.pattern.starts.numpy()[: count + 1], found.pattern.columns.numpy()
        return matrix(dissected(operator.body.rest_positions[:count], starts, columns, parts))

    def _find_rows(self, parts: int) -> None:
        """Find the rows of the whole matrix, where the entries of each body are in it, and how threads share it."""
        self._rows = Rows()
        starts, columns, spans, self._firsts, first = [], [], [], [], 0
        diagonal, span_of, nodes = *np.zeros((2, self._count), np.int64), np.arange(self._count)
        levels = max((len(body.edges) - 1) // parts for body in self._bodies)
        for body, at, end in zip(self._bodies, self.blocks.starts, self.blocks.ends, strict=True):
            found, count = body.pattern, body.operator.node_count
            edges = np.pad(body.edges, (0, levels * parts + 1 - len(body.edges)), "edge")
            self._firsts.append(first)
            for world in range(body.operator.worlds if self._together else 1):
                row = at + world * count
                starts.append(first + found.starts.numpy()[:count])
                columns.append(row + found.columns.numpy()[: found.entries])
                diagonal[row : row + count] = first + found.diagonal.numpy()[:count]
                nodes[row : row + count] = row + body.nodes.numpy()
                span_of[row : row + count] = np.repeat(np.arange(levels * parts), np.diff(edges))
                spans.append(row + np.stack([edges[:-1], edges[1:]], axis=1))
                first += found.entries
            # Rows of nodes that there may be later have a zero.
            spare = np.arange(row + count, end if self._together else row + count)
            starts.append(first + np.arange(len(spare)))
            columns.append(spare)
            diagonal[spare] = starts[-1]
            first += len(spare)
        starts.append(np.array([first]))
        self._entries = first
        self._rows.starts, self._rows.columns, self._diagonal = (
            wp.array(each, dtype=wp.int32, device=self.device)
            for each in (np.concatenate(starts), np.concatenate(columns), diagonal)
        )
        self._division = kernels.Division()
        for name, numbers in {"nodes": nodes, "rows": np.argsort(nodes), "spans_of": span_of}.items():
            setattr(self._division, name, wp.array(numbers, dtype=wp.int32, device=self.device))
        self._division.spans = wp.array(np.stack(spans, axis=1), dtype=wp.vec2i, device=self.device)

    def _make_couplings(self, nodes: int) -> None:
        self.couplings, room = kernels.Couplings(), max(ROOM * nodes, LEAST_ROOM) if self.touches else 1
        for name, dtype, size in (
            ("count", wp.int32, 1),
            ("nodes", wp.int32, (room, kernels.PLACES)),
            ("parts", wp.vec4, (room, kernels.PLACES)),
            ("blocks", wp.mat33, nodes),
            ("single", wp.mat33, nodes),
        ):
            setattr(self.couplings, name, wp.zeros(size, dtype=dtype, device=self.device))
        entries = kernels.ContactEntries()
        many = ENTRIES * room if self.touches and self.device.is_cpu else 1
        for name, size in {"count": 1, "heads": nodes, "next": many, "columns": many, "beside_count": 1}.items():
            setattr(entries, name, wp.zeros(size, dtype=wp.int32, device=self.device))
        entries.blocks = wp.zeros(many, dtype=wp.mat33, device=self.device)
        entries.beside = wp.zeros(room, dtype=wp.int32, device=self.device)
        self._of_contacts, self._marks = entries, wp.zeros(nodes, dtype=wp.int32, device=self.device)

    def _find_launch(self, data: kernels.Solve) -> None:
        """Find how blocks share the worlds, and threads the rows."""
        count, worlds, teams = self._count, self._worlds, 1
        if self.device.is_cpu:
            self._dim, self._block = 1, 256
            data.per_team, data.lanes = self._regions.team.parts, 1
        else:
            blocks = self.device.sm_count
            # A block with few nodes mostly waits for the others.
            data.per_team = max(min(blocks // worlds, count * MOST_LANES // THREADS), 1)
            teams = min(blocks // data.per_team, worlds)
            own = -(-count // data.per_team)
            # Long rows are shared by more lanes.
            long = self._entries > MOST_LANES * count
            lanes, self._block = 2 * FEWEST_LANES if long else FEWEST_LANES, THREADS
            while lanes < MOST_LANES and 2 * lanes * own <= THREADS:
                lanes *= 2
            self._dim, data.lanes = teams * data.per_team * THREADS, lanes
        sums = kernels.LINE * max(worlds, data.per_team) if self.device.is_cpu else 3 * teams * data.per_team
        data.parts = wp.zeros(sums, dtype=wp.float64, device=self.device)
        data.barriers = wp.zeros(STRIDE * teams, dtype=wp.uint32, device=self.device)

    @property
    def threads(self) -> int:
        """Number of threads of the CPU that share the rows of a world; one if they take whole worlds."""
        parts = self._regions.team.parts
        return parts if self._worlds < parts else 1

    @property
    def kernels(self) -> list[LoadedKernel]:
        """Kernels that it launches, beside those of ``loading.IMPLICIT_ON_FORESTS``."""
        found: list[LoadedKernel] = [kernel for body in self._bodies for kernel in body.leaves.kernels]
        return [*found, (kernels.solve, self._block)]

    # --- launches ----------------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Launch the computation of the matrix at the operators' displacements and scales, without contacts."""
        for body, at, first in zip(self._bodies, self.blocks.starts, self._firsts, strict=True):
            operator, count = body.operator, body.operator.node_count
            inputs = [count, count, body.nodes, operator.inverse_mass]
            dim = (operator.worlds, count)
            wp.launch(values.find_free, dim, inputs, [body.free], device=self.device)
            blocks = self._rows.blocks[first : first + operator.worlds * body.pattern.entries + 1]
            body.leaves.gather(operator, blocks, self._inverses[at:], holds=True)
        self._launch(kernels.keep_diagonal, self._count, [self.diagonal])
        if self.device.is_cuda:
            self._launch(kernels.lay_out, self._entries, [])
        self._empty()
        self._finish(is_new=True)

    def take_contact(self, contact: Contact) -> None:
        """Launch the exchange of the contacts in the matrix for the present ones."""
        self._empty()
        contact.add_couplings(self.couplings)
        self._finish(is_new=False)
        if self.device.is_cpu:
            self._of_contacts.heads.fill_(-1)
            wp.launch(kernels.add_entries, 1, [self.threads, self._data], device=self.device)

    def iterate(self, solver: ConjugateGradients, x: wp.array) -> None:
        """Launch iterations from the residual of x that a solve has begun with, in the worlds that run."""
        data = self._data
        if self.device.is_cuda and data.per_team > 1:
            data.barriers.zero_()
        data.most, data.x, data.r, data.scalars = solver.most, x, solver.r, solver.scalars
        data.status, data.iterations = solver.status, solver.iterations
        wp.launch(kernels.solve, self._dim, [data], device=self.device, block_dim=self._block)

    # --- on the host -------------------------------------------------------------------------------------------------

    def largest_frequency(self) -> float:
        """The largest frequency of a free node among fixed ones at the present displacements [rad/s]; waits for the
        device."""
        for operator in self._operators:
            operator.take(operator.body.state.displacements)
            operator.set_scales(0.0, 0.0, 1.0)
        self.update()
        found = [0.0]
        for operator, own in zip(self._operators, self.blocks.of(self.diagonal), strict=True):
            # The arrays of a mesh that changes have more room.
            nodes = operator.worlds * operator.node_count
            mass, blocks = operator.inverse_mass.numpy()[:nodes], own.numpy()[:nodes].astype(float)
            stiffness = np.nan_to_num(np.trace(blocks, axis1=1, axis2=2) / 3.0, posinf=1e38)
            found.append(float((stiffness * mass).max(initial=0.0)))
        return math.sqrt(max(found))

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _empty(self) -> None:
        couplings, entries = self.couplings, self._of_contacts
        for each in (couplings.count, couplings.blocks, couplings.single, entries.count, entries.beside_count):
            each.zero_()

    def _finish(self, *, is_new: bool) -> None:
        inputs = [0, int(is_new), self.diagonal, self._marks, self._data]
        self._regions.launch_from(kernels.finish_matrix, (self._worlds, self._count), inputs, [])

    def _launch(self, kernel: wp.Kernel, count: int, others: list[Any]) -> None:
        """Launch a kernel with ``count`` threads for each world of the matrix."""
        wp.launch(kernel, (self._worlds, count), [self._data, *others], device=self.device)
