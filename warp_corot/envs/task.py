"""What tasks declare, and their meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.controls import Nodes
from warp_corot.contact.shapes import Shape, Vector
from warp_corot.contact.tool import Tool
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers, shown
from warp_corot.mesh.forest import TetForest
from warp_corot.mesh.tetmesh import TetMesh

#: Observations or actions, float32 [n, ...].
Actions = npt.NDArray[np.float32]


@dataclass
class Scene:
    """What a task is made of, in one world.

    Attributes:
        mesh: The tissue at rest.
        fixed: Its held nodes, as for ``SoftBody.fix``; None: none.
        tools: Tools that an episode places; those that actions move come first.
        obstacles: Obstacles at rest.
        points: Observed nodes, [P].
        centre: About which the tissue is turned [m].
        parts: Which part of the mesh each node is of, [n], where parts are placed by themselves; None: it is one.
        gripped: Nodes that the first tool holds while it is closed; None: it is no gripper.
        reach: Distance from its origin at which it takes hold of them [m].
        friction: Coefficient of friction of all contacts without their own.
    """

    mesh: TetMesh
    fixed: Nodes | None
    tools: list[Tool]
    obstacles: list[Shape]
    points: npt.NDArray[np.integer]
    centre: Vector
    parts: npt.NDArray[np.integer] | None = None
    gripped: Nodes | None = None
    reach: float = 0.0
    friction: float = 0.3


@dataclass
class Task:
    """What a task declares.

    Attributes:
        ranges: The lowest and the highest value of each number that is drawn for an episode: ``young`` [Pa],
            ``shift_x`` and ``shift_y`` [m] and ``turn`` [rad], which place the tissue, and then those of the task, in
            the order of its kernels.
        begin, begun: The kernel of ``kernels.envs.tasks`` with which an episode begins, and its constants.
        judge, judged: The kernel that judges steps, and its constants.
        actions: How many actions there are.
        speed: The largest speed of tools along each axis [m/s].
        workspace: Lowest and highest place of the tools' origin [m].
        window: Lowest and highest corner of what pictures show [m].
        view: Azimuth and elevation of the camera [°].
        notes: Names and sizes of the task's own numbers among the observations.
        steps: Steps of an episode until it is cut off.
        feels_stress: Whether steps find the largest stress of the tissue.
    """

    ranges: Mapping[str, tuple[float, float]]
    begin: wp.Kernel
    begun: tuple[Any, ...]
    judge: wp.Kernel
    judged: tuple[Any, ...]
    actions: int
    speed: float
    workspace: tuple[Vector, Vector]
    window: tuple[Vector, Vector]
    view: tuple[float, float]
    notes: Mapping[str, int] = field(default_factory=dict)
    steps: int = 200
    feels_stress: bool = False


def checked_ranges(
    declared: Mapping[str, tuple[float, float]], given: Mapping[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Declared ranges with given ones in their place.

    Raises:
        InputError: A given range has no such name or is none.
    """
    ranges = {name: (float(low), float(high)) for name, (low, high) in declared.items()}
    for name, bounds in (given or {}).items():
        if name not in ranges:
            raise InputError(f"there is no range {shown(name)}; there are {', '.join(ranges)}")
        pair = checked_numbers(bounds, name, "[2]")
        if pair.shape != (2,) or not np.isfinite(pair).all() or pair[0] > pair[1] or (name == "young" and pair[0] <= 0):
            raise InputError(f"the range {name} is {bounds}; it must be a lowest and a highest number")
        ranges[name] = float(pair[0]), float(pair[1])
    return ranges


def columns_of(sizes: Mapping[str, int]) -> dict[str, slice]:
    """The place of each named part among numbers in a row."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def symmetric(**largest: float) -> dict[str, tuple[float, float]]:
    """Ranges around zero."""
    return {name: (-most, most) for name, most in largest.items()}


def box(
    counts: tuple[int, int, int],
    edges: tuple[float, float, float],
    cells: int = 1,
    without: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]] | None = None,
) -> TetMesh:
    """A box with a corner at the origin, of cubes with six tetrahedra each.

    Args:
        counts: Numbers of cubes along x, y and z.
        edges: Edges of the box [m].
        cells: Factor on the counts.
        without: Which points [n, 3] [m] are not in the body, for the cubes' centroids.
    """
    x, y, z = counts
    whole = TetForest.box((cells * x, cells * y, cells * z))
    points = whole.points * (np.asarray(edges) / (cells * np.asarray(counts)))
    tets = np.asarray(whole.tets)
    if without is not None:
        size = np.asarray(edges) / np.asarray(counts)
        cubes = (np.floor(points[tets].mean(axis=1) / size) + 0.5) * size
        used, tets = np.unique(tets[~without(cubes)], return_inverse=True)
        points, tets = points[used], tets.reshape(-1, 4)
    return TetMesh(points, tets, up_axis="Z")


def nodes_at(mesh: TetMesh, places: Sequence[Sequence[float]]) -> npt.NDArray[np.int32]:
    """The nodes nearest to places [m]."""
    away = np.linalg.norm(mesh.points[:, None] - np.asarray(places), axis=2)
    return np.argmin(away, axis=0).astype(np.int32)
