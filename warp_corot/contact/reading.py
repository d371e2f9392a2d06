"""The contacts of the last step for the host, one by one and at nodes; and warnings."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.domain.units import length
from warp_corot.errors import StabilityWarning, depth_of_user
from warp_corot.kernels.contact import shapes as kinds
from warp_corot.kernels.contact.search import count_crushed
from warp_corot.mesh.surfaces.bound import SurfaceMesh
from warp_corot.solvers.halo import ALONE

from .obstacles import RigidForces, measured_gaps
from .shapes import Capsule, Cylinder, Ground, SignedDistance, TriangleMesh, axis_of
from .tool import FITTING

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

    from .parts import AllContacts
    from .search import Pairs
    from .tool import Obstacle, Tool

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ContactPoint:
    """A place at which a body was touched in the last step.

    Attributes:
        body: The soft body.
        other: The other side: an obstacle as it was given, or a soft body, which may be the same.
        world: The world.
        nodes: The body's nodes at that place, numbered within the world: one, the ends of an edge, or the corners of a
            triangle; on a body's own surface those of the tetrahedra that carry the place.
        shares: The weight of each of them in the point.
        point: The place [m], [3].
        normal: From the other to the body, [3].
        gap: The gap at the beginning of the step, negative for an overlap [m].
        normal_force: The force on the body along the normal [N], never negative.
        friction_force: The force on the body across the normal [N], [3].
        other_nodes: The nodes of the other, if that is a soft body.
    """

    body: SoftBody
    other: Obstacle | SoftBody
    world: int
    nodes: tuple[int, ...]
    shares: Floats
    point: Floats
    normal: Floats
    gap: float
    normal_force: float
    friction_force: Floats
    other_nodes: tuple[int, ...] = ()

    @property
    def force(self) -> Floats:
        """The whole force on the body [N], [3]."""
        return self.normal_force * self.normal + self.friction_force


class ActingRow(NamedTuple):
    """A contact that pushed in the last step.

    Attributes:
        obstacle: The number of the obstacle; -1 for a pair of soft surfaces.
        first: Number of places on the first side, which has the normal: all of them at an obstacle.
        places: Numbers of places of the contact surface: one, a triangle's three, or a pair's four.
        weights: The weight of each in the gap, negative on the second side.
        point: The place on the first side [m], [3].
        normal, gap: As of a ``ContactPoint``.
        force: The force on the first side [N], [3].
    """

    obstacle: int
    first: int
    places: npt.NDArray[np.integer]
    weights: Floats
    point: Floats
    normal: Floats
    gap: float
    force: Floats


def contact_points(contacts: AllContacts) -> list[ContactPoint]:
    """All contacts of the last step, pairs of soft surfaces once; waits for the device."""
    return [_point(contacts, row) for row in acting_rows(contacts)]


def acting_rows(contacts: AllContacts) -> Iterator[ActingRow]:
    """All contacts of the last step; waits for the device."""
    x = contacts.surface.arrays.x.numpy().astype(float)
    if contacts.pairs is not None:
        yield from _of_pairs(contacts.pairs, x, contacts.surface.count)
    if contacts.rigid is not None:
        yield from _at_places(contacts, contacts.rigid, x)
        if contacts.rigid.have_edges:
            yield from _at_triangles(contacts.rigid, contacts.surface.triangles.numpy(), x)


def _of_pairs(pairs: Pairs, x: Floats, nodes: int) -> Iterator[ActingRow]:
    rows = pairs.rows
    count = min(int(rows.total.numpy()[0]), len(rows.owner))
    acts, owner, gap = (each.numpy()[:count] for each in (rows.acts, rows.owner, rows.gap))
    force, normal, weights = (each.numpy()[:count].astype(float) for each in (rows.force, rows.normal, rows.weights))
    places = rows.places.numpy()
    for k in np.flatnonzero((acts != 0) & force.any(axis=1)):
        first = 1 if owner[k] < nodes else 2
        point = weights[k, :first] @ x[places[k, :first]]
        yield ActingRow(-1, first, places[k], weights[k], point, normal[k], float(gap[k]), force[k])


def _at_places(contacts: AllContacts, rigid: RigidForces, x: Floats) -> Iterator[ActingRow]:
    forces, obstacles = rigid.forces.numpy().astype(float), contacts.obstacles
    those, places = np.nonzero(forces.any(axis=2))
    given = those, contacts.surface.arrays.world.numpy()[places], x[places, None]
    gap, normal = (each[:, 0].astype(float) for each in measured_gaps(obstacles.shapes, obstacles.motions.now, *given))
    for k, (o, s) in enumerate(zip(those, places, strict=True)):
        yield ActingRow(int(o), 1, np.array([s]), np.ones(1), x[s], normal[k], float(gap[k]), forces[o, s])


def _at_triangles(rigid: RigidForces, corners: npt.NDArray[np.integer], x: Floats) -> Iterator[ActingRow]:
    rows, first = rigid.rows, rigid.totals.size
    acts, gap = rows.acts.numpy(), rows.gap.numpy()
    force, weights, normal = (each.numpy().astype(float) for each in (rows.force, rows.weights, rows.normal))
    for r in first + np.flatnonzero((acts != 0)[first:] & force[first:].any(axis=1)):
        o, t = divmod(int(r) - first, len(corners))
        w, places = weights[r, :3], corners[t]
        yield ActingRow(o, 3, places, w, w @ x[places], normal[r], float(gap[r]), force[r])


def _point(contacts: AllContacts, row: ActingRow) -> ContactPoint:
    surface, bodies = contacts.surface, contacts.system.bodies
    k, world, nodes, shares = surface.nodes_at(row.places[: row.first], row.weights[: row.first])
    other: Obstacle | SoftBody
    others: tuple[int, ...] = ()
    if row.obstacle >= 0:
        other = contacts.obstacles.given[row.obstacle]
    else:
        m, _, others, _ = surface.nodes_at(row.places[row.first :], row.weights[row.first :])
        other = bodies[m]
    push = float(row.force @ row.normal)
    across = row.force - push * row.normal
    return ContactPoint(bodies[k], other, world, nodes, shares, row.point, row.normal, row.gap, push, across, others)


# --- at nodes ---------------------------------------------------------------------------------------------------------


def contact_at_nodes(
    contacts: AllContacts, k: int, body: SoftBody, world: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Contact of a body in the last step; waits for the device. Zero if the mesh has changed since.

    Args:
        contacts: Contact of the simulation.
        k: The number of the body there.
        body: The body; on several ranks the whole one, of which ``contacts`` has this rank's part.
        world: The world.

    Returns:
        The forces on the nodes of one world [N], float32 [N, 3], and the pressure averaged at them [Pa], float32 [N].
    """
    count = body.world_node_count
    if contacts.surface.bodies[k].version != contacts.surface.parts[k].version:
        return np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    forces = body.contact_forces.numpy()[world * count : (world + 1) * count]
    pressures = body.contact_pressure.numpy().reshape(body.worlds, -1)[world]
    nodal = pressure_at_nodes(body.contact_surface, count, pressures)
    return forces.astype(np.float32), nodal.astype(np.float32)


def pressure_at_nodes(surface: SurfaceMesh, count: int, pressures: npt.NDArray[np.float32]) -> Floats:
    """Pressures of triangles [Pa], averaged at nodes by areas at rest, [N]; zero at nodes that carry no surface.

    Args:
        surface: The surface, F triangles.
        count: Number of nodes N.
        pressures: [F], or more, of which the first ones count.
    """
    triangles = surface.triangles
    a, b, c = np.moveaxis(surface.points[triangles], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners, points = triangles.ravel(), len(surface.points)
    around = np.bincount(corners, np.repeat(areas, 3), points)
    loads = np.bincount(corners, np.repeat(areas * pressures[: len(triangles)], 3), points)
    nodes, weights = surface.nodes.ravel(), np.abs(surface.weights)
    weighted = np.bincount(nodes, (weights * loads[:, None]).ravel(), count)
    return weighted / np.maximum(np.bincount(nodes, (weights * around[:, None]).ravel(), count), 1e-300)


# --- warnings ---------------------------------------------------------------------------------------------------------

#: Overlaps larger than this fraction of the smallest element's size are reported.
OVERLAP = 0.01
#: Number of points of a tool's axis that are searched in bodies.
ALONG = 9

#: Places of the surface nodes of a body [m], and its triangles.
Surface = tuple[Floats, npt.NDArray[np.int32]]


def warn_of_overlaps(contacts: AllContacts, least: float) -> None:
    """Check whether anything begins inside something else: obstacles in all worlds, soft bodies in the first.

    Args:
        contacts: Contact in a state that has not been stepped.
        least: The smallest overlap that is reported [m].

    Warns:
        StabilityWarning: Surface nodes begin inside obstacles or other bodies, or a tool in a body.
    """
    speed = f"pushed out at no more than {contacts.law.recovery:.2g} m/s"
    if contacts.obstacles.count:
        arrays, obstacles = contacts.surface.arrays, contacts.obstacles
        moves = np.flatnonzero((arrays.node.numpy() >= 0) & (arrays.yielding.numpy() > 0.0))
        worlds, points = (np.tile(each.numpy()[moves], (obstacles.count, 1)) for each in (arrays.world, arrays.x))
        numbers = np.repeat(np.arange(obstacles.count), len(moves))
        given = numbers, worlds.ravel(), points.reshape(-1, 1, 3), 1e-3
        gaps, _ = measured_gaps(obstacles.shapes, obstacles.motions.later, *given)
        deep, ranks = -gaps.reshape(obstacles.count, -1).min(axis=0), contacts.system.ranks
        ranks = ALONE if contacts.surface.is_whole else ranks
        count, deepest = int(ranks.sum(int((deep > least).sum()))), ranks.max(float(deep.max(initial=0.0)))
        if count:
            _warn(f"{count} surface nodes begin inside obstacles, by up to {length(deepest)}; they are {speed}")
    axes = [(tool, _axis(tool, contacts.obstacles.poses()[0, k])) for k, tool in enumerate(contacts.obstacles.tools)]
    axes = [(tool, points) for tool, points in axes if len(points)]
    if len(contacts.surface.parts) > 1 or axes:
        surfaces = list(_own_surfaces(contacts))
        _warn_of_what_bodies_hold(contacts, surfaces, axes, least, speed)
        for tool, points in axes:
            _warn_of_coarse_elements(contacts, surfaces, tool, points)


def _own_surfaces(contacts: AllContacts) -> Iterator[Surface]:
    """Where the surface nodes of each body are in its first world [m], and its triangles."""
    places = contacts.surface.arrays.x.numpy().astype(float)
    for body, part in zip(contacts.system.bodies, contacts.surface.parts, strict=True):
        whole = contacts.system.ranks.owned(body).whole
        if whole is body or contacts.surface.is_whole:
            yield places[part.start : part.start + len(part.skin.nodes)], part.skin.triangles
        else:
            triangles = whole.surface_triangles
            nodes, corners = np.unique(triangles, return_inverse=True)
            yield whole.positions.numpy()[nodes].astype(float), corners.reshape(-1, 3).astype(np.int32)


def warn_of_crushed(contacts: AllContacts) -> bool:
    """Check whether elements are turned inside out now; waits for the device.

    Warns:
        StabilityWarning: Some are.
    """
    system = contacts.system
    count = wp.zeros(1, dtype=wp.int32, device=contacts.device)
    for body in system.bodies:
        kernel = count_crushed(body.discretization.element_kind)
        inputs = [body.discretization.elements, body.state.displacements, system.ranks.owned(body).counted]
        wp.launch(kernel, body.sizes.launch_elements, inputs, [count], device=contacts.device)
    crushed = int(system.ranks.sum(int(count.numpy()[0])))
    if crushed:
        _warn(
            f"{crushed} element{' is' if crushed == 1 else 's are'} turned inside out at t = {system.pace.time:.4g} s: "
            "something presses harder than they bear. Tissue would tear there, and contact forces are rough meanwhile; "
            "slower or blunter tools, finer elements or the model NeoHookean help"
        )
    return crushed > 0


# --- pieces ----------------------------------------------------------------------------------------------------------


def _warn_of_coarse_elements(contacts: AllContacts, surfaces: Sequence[Surface], tool: Tool, points: Floats) -> None:
    """Warn of a tool that moves and is smaller than the elements of the body nearest to it, where it is nearest."""
    nearest = []
    for body, (places, triangles) in zip(contacts.system.bodies, surfaces, strict=True):
        corners = places[triangles]
        away = np.linalg.norm(corners.mean(axis=1)[:, None] - points, axis=2).min(axis=1)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        nearest.append((away.min(), float(np.median(sides[away <= away.min() + tool.shape.thickness])), body))
    _, edge, body = min(nearest, key=lambda each: each[0])
    size = tool.shape.thickness
    if edge > size and body.changing is None and (tool.keys is not None or tool.is_sent):
        fine = FITTING * size
        count = float(f"{len(body.mesh.tets) * (edge / fine) ** 3:.1g}")
        _warn(
            f"a {tool.shape!r}, {length(2.0 * size)} thick, is small for the elements under it, whose edges are "
            f"{length(edge)}: its force will be off by tens of per cent; edges of {length(fine)} would do, in all "
            f"some {count:,.0f} elements, or OnlineRemesh(near=tool)"
        )


def _warn_of_what_bodies_hold(
    contacts: AllContacts, surfaces: Sequence[Surface], axes: list[tuple[Tool, Floats]], least: float, speed: str
) -> None:
    """Warn of nodes of bodies, and of axes of tools, that begin inside other bodies."""
    own = [points for points, _ in surfaces]
    ends = np.cumsum([0, *(len(points) for points in own), *(len(points) for _, points in axes)])
    points = np.concatenate(own + [each for _, each in axes])
    deepest = np.zeros(len(points))
    for k, (_, triangles) in enumerate(surfaces):
        depths = _depths(own[k], triangles, points, contacts.device)
        depths[ends[k] : ends[k + 1]] = 0.0
        deepest = np.maximum(deepest, depths)
    deep = deepest[: ends[len(own)]]
    if count := int((deep > least).sum()):
        _warn(
            f"{count} surface nodes begin inside another soft body, by up to {length(deep.max())}; overlaps of up to "
            f"a quarter of an element are {speed}, deeper ones stay"
        )
    for (tool, _), start, end in zip(axes, ends[len(own) :], ends[len(own) + 1 :], strict=False):
        if (deepest[start:end] > least).any():
            _warn(f"a {tool.shape!r} begins inside a soft body, where nothing pushes it out; begin outside of it")


def _axis(tool: Tool, pose: Floats) -> Floats:
    """Points inside a tool, which may lie between the nodes of a body, [n, 3]; none if its middle is not known."""
    shape = tool.shape
    if isinstance(shape, Ground | TriangleMesh | SignedDistance):
        return np.zeros((0, 3))
    half = shape.size[1] if isinstance(shape, Capsule | Cylinder) else 0.0
    return pose[:3] + np.linspace(-half, half, ALONG if half else 1)[:, None] * axis_of(pose[3:])


def _depths(surface: Floats, triangles: npt.NDArray[np.int32], points: Floats, device: wp.Device) -> Floats:
    """How deep points are inside a closed surface [m]; zero outside."""
    reach = float(np.linalg.norm(np.ptp(surface, axis=0)))
    inside = ((points >= surface.min(axis=0)) & (points <= surface.max(axis=0))).all(axis=1)
    depths = np.zeros(len(points))
    if not inside.any():
        return depths
    corners = wp.array(surface, dtype=wp.vec3, device=device)
    mesh = wp.Mesh(corners, wp.array(triangles.ravel(), dtype=wp.int32, device=device))
    shape = kinds.Shapes()
    shape.kind = wp.array([int(kinds.MESH)], dtype=wp.int32, device=device)
    shape.size = wp.array([[1e-6 * reach, 0.0, 0.0]], dtype=wp.vec3, device=device)
    shape.source = wp.array([mesh.id], dtype=wp.uint64, device=device)
    pose = wp.array([[[0, 0, 0, 0, 0, 0, 1]]], dtype=wp.transform, device=device)
    gaps, _ = measured_gaps(shape, pose, [0], [0], points[inside][None], reach)
    depths[inside] = np.maximum(-gaps[0], 0.0)
    return depths


def _warn(message: str) -> None:
    warnings.warn(message, StabilityWarning, stacklevel=depth_of_user())
