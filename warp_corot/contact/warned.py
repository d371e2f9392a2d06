"""Warnings: of overlaps and of coarse elements before anything moves, and of elements that tools turn inside out."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.domain.units import length
from warp_corot.errors import StabilityWarning, depth_of_user
from warp_corot.kernels.contact import shapes as kinds
from warp_corot.kernels.contact.crushed import count_crushed
from warp_corot.solvers.halo import ALONE

from .obstacles import measured_gaps
from .shapes import Capsule, Cylinder, Ground, SignedDistance, TriangleMesh, axis_of
from .tool import FITTING

if TYPE_CHECKING:
    from .contacts import Contacts
    from .tool import Tool

#: Overlaps larger than this fraction of the smallest element's size are reported.
OVERLAP = 0.01
#: Number of points of a tool's axis that are searched in bodies.
ALONG = 9

Floats = npt.NDArray[np.float64]
#: Places of the surface nodes of a body [m], and its triangles.
Surface = tuple[Floats, npt.NDArray[np.int32]]


def warn_of_overlaps(contacts: Contacts, least: float) -> None:
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


def _own_surfaces(contacts: Contacts) -> Iterator[Surface]:
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


def warn_of_crushed(contacts: Contacts) -> bool:
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


def _warn_of_coarse_elements(contacts: Contacts, surfaces: Sequence[Surface], tool: Tool, points: Floats) -> None:
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
    contacts: Contacts, surfaces: Sequence[Surface], axes: list[tuple[Tool, Floats]], least: float, speed: str
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
