"""Parts of a body that options name: expressions, regions, patches of ``--patch``; and the loads on them."""

from __future__ import annotations

import argparse
import keyword
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.body.controls import TAKEN, named_nodes
from warp_corot.domain.units import in_units
from warp_corot.errors import InputError
from warp_corot.holding.choice import LOWEST, BodyShape, flat_region
from warp_corot.inputs.checks import checked_times
from warp_corot.inputs.selection import select_nodes
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.topology import boundary_faces

from .options import LOADS

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.discretization.elements import Mesh
    from warp_corot.mesh.surfaces.bound import SurfaceMesh
    from warp_corot.simulation.simulation import Simulation

    from .input_mesh import InputMesh

#: A point, three numbers.
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
POINT = re.compile(rf"\s*({_NUMBER})[\s,]+({_NUMBER})[\s,]+({_NUMBER})\s*")
Mask = npt.NDArray[np.bool_]
Array = npt.NDArray[np.float64]


class BodyPatches:
    """The patches of a body.

    Args:
        subject: The body.
        up: Unit vector against gravity.
        given: The arguments of ``--patch``, each ``NAME=EXPR``.

    Raises:
        InputError: Another form, or an invalid name.
    """

    def __init__(self, subject: InputMesh, up: Array, given: Sequence[str] = ()):
        self.subject = subject
        self.used = subject.used
        self._up, self._given = up, given
        self._named: dict[str, Callable[[], Mask]] = {
            "bottom": lambda: self._end(-up),
            "top": lambda: self._end(up),
            "flat": self._flat,
            "surface": lambda: np.isin(self.used, boundary_faces(subject.mesh.tets, subject.mesh.points)[0]),
        }
        for name, mask in named_nodes(subject.mesh).items():
            self._named[name] = lambda mask=mask: mask()[self.used]  # type: ignore[misc]
        for text in given:
            name, equals, expression = (part.strip() for part in text.partition("="))
            if not equals or not re.fullmatch(r"[A-Za-z_]\w*", name) or not expression:
                raise InputError(f"--patch {text!r}: it must be NAME=EXPR, for example tip=nearest(0, 0, 0.1)")
            if name in TAKEN or keyword.iskeyword(name) or name in self._named:
                raise InputError(f"--patch {text!r}: {name} is already a name; it must be another one")
            self._named[name] = partial(np.array, self.nodes(expression)[self.used])

    def of_mesh(self, mesh: Mesh) -> BodyPatches:
        """The same patches on the body's changed mesh."""
        if mesh is self.subject.mesh:
            return self
        return BodyPatches(replace(self.subject, mesh=mesh), self._up, self._given)

    def nodes(self, expression: str) -> Mask:
        """Nodes of a patch, bool [N]; nodes in no tetrahedron are in no patch.

        Raises:
            InputError: As in `select_nodes`.
        """
        points = self.subject.mesh.points
        mask = np.zeros(len(points), bool)
        mask[self.used] = self._selected(expression, points[self.used], lambda own: own)
        return mask

    def _selected(self, expression: str, points: Array, convert: Callable[[Mask], Mask]) -> Mask:
        """The points of a patch; ``convert`` makes a mask of points from one of the used nodes."""
        named = {name: lambda own=own: convert(own()) for name, own in self._named.items()}
        return select_nodes(expression, points, bounds=self.subject.bounds, named=named)

    def some(self, expression: str, option: str) -> Mask:
        """Nodes of a patch that must not be empty.

        Raises:
            InputError: It is empty, or as in `nodes`.
        """
        try:
            mask = self.nodes(expression)
        except InputError as error:
            raise InputError(f"{option}: {error}") from None
        if not mask.any():
            raise InputError(f"{option} {expression!r}: there are no nodes in it")
        return mask

    def tetrahedra(self, expression: str) -> Mask:
        """Tetrahedra whose centre is in a patch, bool [T]; for named patches, those with all nodes in it.

        Raises:
            InputError: As in `select_nodes`.
        """
        tets, mesh = self.subject.mesh.tets, self.subject.mesh
        places = np.searchsorted(self.used, tets)
        return self._selected(expression, mesh.points[tets].mean(axis=1), lambda own: np.all(own[places], axis=1))

    def on_surface(self, expression: str, surface: SurfaceMesh) -> Mask:
        """Points of a bound surface that are in a patch, bool [V]; for named patches, those bound to it by half or
        more.

        Raises:
            InputError: As in `select_nodes`.
        """
        inside = np.zeros(len(self.subject.mesh.points), bool)

        def bound(own: Mask) -> Mask:
            inside[self.used] = own
            return np.einsum("vn,vn->v", surface.weights, inside[surface.nodes]) >= 0.5

        return self._selected(expression, surface.points, bound)

    def has(self, probe: str) -> bool:
        """Whether the patch of ``--probe`` has nodes, or the box around the body contains its point.

        Raises:
            InputError: As in `nodes`.
        """
        match = POINT.fullmatch(probe)
        if match is None:
            return bool(self.nodes(probe).any())
        point, (low, high) = np.array([float(part) for part in match.groups()]), self.subject.bounds
        return bool(((low <= point) & (point <= high)).all())

    @cached_property
    def shape(self) -> BodyShape:
        """The whole body."""
        mesh, surface = self.subject.mesh, self.subject.surface
        if surface is not None:
            return BodyShape(mesh.points, self.used, surface.points, surface.triangles, self._up)
        return BodyShape(mesh.points, self.used, mesh.points, boundary_faces(mesh.tets, mesh.points)[0], self._up)

    def _end(self, way: Array) -> Mask:
        return np.isin(self.used, self.shape.beyond(way, LOWEST))

    def _flat(self) -> Mask:
        patch = flat_region(self.shape)
        if patch is None:
            raise InputError(f"{self.subject.name}: no region of its surface is flat")
        return np.isin(self.used, patch.nodes)


def up_of(subject: InputMesh, gravity: Array) -> Array:
    """The unit vector against gravity; the mesh's up axis without gravity."""
    if not gravity.any():
        return np.eye(3)["XYZ".index(subject.mesh.up_axis)]
    return -gravity / np.linalg.norm(gravity)


# --- loads over time: ``--pull``, ``--twist`` and ``--press`` --------------------------------------------------------

#: Units of values that have none.
UNITS = {"pull": "m", "twist": "degree", "press": "Pa"}
#: Largest angle between keyframes of a twist [degrees]: nodes move straight in between.
KEY_ANGLE = 5.0


@dataclass(frozen=True)
class Load:
    """A load on a patch.

    Attributes:
        kind: "pull", "twist" or "press".
        patch: The expression.
        values: Displacement [m], angle [degrees] or pressure [Pa].
        times: Increasing [s]; () for a ramp whose length is given elsewhere.
        shares: Fractions of the values at these times; linear in between, constant before and after.
        axis: Axis of a twist; None: the mean normal of the patch's surface.
    """

    kind: str
    patch: str
    values: tuple[float, ...]
    times: tuple[float, ...] = ()
    shares: tuple[float, ...] = ()
    axis: tuple[float, float, float] | None = None

    def curve(self, ramp: float) -> tuple[Array, Array]:
        """Times [s] and fractions at them.

        Raises:
            InputError: Their numbers differ, or times do not increase.
        """
        if not self.times:
            return np.array([0.0, ramp]), np.array([0.0, 1.0])
        times, shares = checked_times(self.times), np.asarray(self.shares, dtype=np.float64)
        if shares.shape != times.shape or not np.isfinite(shares).all():
            raise InputError(f"{self.kind}: shares are {list(self.shares)}; they must be one number for each time")
        return times, shares

    def __str__(self) -> str:
        return f"--{self.kind} {self.patch!r} {' '.join(f'{value:g}' for value in self.values)}"


def loads_of(args: argparse.Namespace) -> list[Load]:
    """The loads in the options.

    Raises:
        InputError: A value is not a number.
    """
    found = list(getattr(args, "curves", ()))
    for kind in LOADS:
        for patch, *texts in getattr(args, kind) or ():
            try:
                found.append(Load(kind, patch, tuple(value_of(kind, text) for text in texts)))
            except InputError as error:
                raise InputError(f"--{kind} {patch!r} {' '.join(texts)}: {error}") from None
    if args.ramp is not None:
        if not (math.isfinite(args.ramp) and args.ramp > 0.0):
            raise InputError(f"--ramp is {args.ramp:g} s; it must be a positive time")
        if not found:
            raise InputError("--ramp is for --pull, --twist and --press, none of which is given")
    return found


def ramp_of(args: argparse.Namespace, duration: float) -> float:
    """The time over which loads grow [s]."""
    return 0.5 * duration if args.ramp is None else args.ramp


def value_of(kind: str, text: str) -> float:
    """A displacement [m], an angle [degrees] or a pressure [Pa], from a number with or without a unit.

    Raises:
        InputError: It is not a number.
    """
    value = in_units(text, UNITS[kind])
    if not math.isfinite(value):
        raise InputError(f"{text} must be a finite number")
    return value


def move_patches(body: SoftBody, loads: Sequence[Load], patches: BodyPatches, ramp: float, fixed: Mask | None) -> None:
    """Prescribe the motion of the patches of ``--pull`` and ``--twist``.

    Args:
        body: The body.
        loads: Its loads.
        patches: Its patches.
        ramp: Time over which loads without times grow [s].
        fixed: Nodes of ``--fix``, bool [N]; None if it was not given. If a patch moves, its nodes among these move,
            too.

    Raises:
        InputError: A patch without nodes, or without a direction if one is needed; a node in two patches; or a
            patch with all nodes fixed.
    """
    taken = np.zeros(len(patches.subject.mesh.points), bool)
    for load in loads:
        if load.kind == "press":
            continue
        mask = patches.some(load.patch, f"--{load.kind}")
        if (mask & taken).any():
            raise InputError(f"{load}: {int((mask & taken).sum())} of its nodes are moved by another option, too")
        taken |= mask
        both = 0 if fixed is None else int((mask & fixed).sum())
        if both == mask.sum():
            raise InputError(f"{load}: all of its nodes are held by --fix")
        if both:
            patches.subject.notes.append(f"{load}: {both} of its nodes are named by --fix, too, and move")
        times, shares = load.curve(ramp)
        if load.kind == "pull":
            moves = shares[:, None] * load.values
        else:
            times, moves = _turned(load, patches, mask, times, shares)
        body.prescribe(mask, times=times, displacements=moves)
    if taken.sum() == len(patches.used):
        raise InputError("all nodes are moved by options; at least one must be free to move")


def _turned(load: Load, patches: BodyPatches, mask: Mask, times: Array, shares: Array) -> tuple[Array, Array]:
    """Keyframes of a twist: times [K], and displacements [K, n, 3]."""
    axis = (
        -pressed(load, patches, surface_of(patches)).sum(axis=0)
        if load.axis is None
        else np.asarray(load.axis, dtype=np.float64)
    )
    length = np.linalg.norm(axis)
    if not (np.isfinite(axis).all() and length > 0.0):
        raise InputError(f"{load}: has no axis; it must be three numbers, not all zero")
    from scipy.spatial.transform import Rotation

    fine = [times[:1]]
    for start, end, span in zip(times, times[1:], np.abs(np.diff(shares)) * abs(load.values[0]), strict=False):
        fine.append(np.linspace(start, end, 1 + max(1, math.ceil(span / KEY_ANGLE)))[1:])
    keys = np.concatenate(fine)
    angles = np.radians(load.values[0]) * np.interp(keys, times, shares)
    points = patches.subject.mesh.points[mask]
    arms = points - points.mean(axis=0)
    return keys, np.stack([Rotation.from_rotvec(angle * axis / length).apply(arms) - arms for angle in angles])


# --- pressures as nodal forces that follow the mesh ------------------------------------------------------------------

#: A changing pressure is updated at least this often.
UPDATES = 200


def press_patches(sim: Simulation, body: SoftBody, loads: Sequence[Load], patches: BodyPatches, ramp: float) -> None:
    """Apply the pressures of ``--press``.

    Args:
        sim: The simulation.
        body: One of its bodies; it may be remeshed.
        loads: The body's loads.
        patches: The body's patches.
        ramp: Time over which loads without times grow [s].

    Raises:
        InputError: A patch contains no part of the surface.
    """
    pressing = [load for load in loads if load.kind == "press"]
    if not pressing:
        return
    surface, curves = surface_of(patches), [load.curve(ramp) for load in pressing]
    forces = [load.values[0] * pressed(load, patches, surface) for load in pressing]
    there = np.any([each.any(axis=1) for each in forces], axis=0)
    of_points = np.stack([each[there] for each in forces])
    following = None if body.changing is None else body.bind(surface.points[there])
    first, last = min(times[0] for times, _ in curves), max(times[-1] for times, _ in curves)
    # The version of the mesh and whether pressures have their last values there, and points bound to its nodes.
    version, is_done = -1, False
    nodes, weights = surface.nodes[there], surface.weights[there]

    def update(time: float) -> None:
        nonlocal version, is_done, nodes, weights
        if version == body.version and (is_done or time < first):
            return
        if following is not None and version != body.version:
            nodes, weights = following.nodes.numpy(), following.weights.numpy()
        version, is_done = body.version, time >= last
        shares = [np.interp(time, times, shares) for times, shares in curves]
        at_points, at_nodes = np.einsum("p,pvx->vx", shares, of_points), np.zeros((body.node_count, 3))
        np.add.at(at_nodes, nodes.ravel(), (weights[:, :, None] * at_points[:, None]).reshape(-1, 3))
        body.load("all", at_nodes)

    update(0.0)
    sim.on_step(lambda sim: update(sim.time), every=max(1, int(float(last - first) / UPDATES / sim.dt)))
    for options in sim.remesh:
        if options is not None:
            sim.on_step(lambda sim: update(sim.time), every=options.every)


def surface_of(patches: BodyPatches) -> SurfaceMesh:
    """The surface of a body, bound to its nodes."""
    return patches.subject.surface or boundary_surface(patches.subject.mesh)


def pressed(load: Load, patches: BodyPatches, surface: SurfaceMesh) -> Array:
    """The nodal forces of a pressure of one pascal on a patch, at the points of the surface [N], [V, 3].

    Raises:
        InputError: The patch contains no part of the surface.
    """
    inside = patches.on_surface(load.patch, surface)
    triangles = surface.triangles[inside[surface.triangles].all(axis=1)]
    if not len(triangles):
        raise InputError(f"--{load.kind} {load.patch!r}: no part of the surface is in it")
    a, b, c = np.moveaxis(surface.points[triangles], 1, 0)
    forces = np.zeros_like(surface.points)
    np.add.at(forces, triangles.ravel(), np.repeat(-np.cross(b - a, c - a) / 6.0, 3, axis=0))
    return forces
