"""Surfaces that are drawn: of bodies, bound to their nodes, and of rigid obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, Sphere, TriangleMesh
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.cutting.blade import Edge
from warp_corot.domain.closing import turned_inwards
from warp_corot.errors import InputError
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.surfaces.bound import SurfaceMesh

if TYPE_CHECKING:
    from typing import TypeAlias

    from warp_corot.io.read.meshes import LoadedMesh
    from warp_corot.io.read.usd.meshes import Look

    Surface: TypeAlias = "SurfaceMesh | OwnSurface | str | PathLike[str]"

#: A surface this many times longer or shorter than its body is probably in another unit.
UNLIKELY = 3.0
#: Bounds that differ by less than this fraction of the length are equal.
SAME = 1.0e-3


@dataclass(frozen=True, eq=False)
class OwnSurface:
    """A user's surface, in the coordinates of the body's mesh.

    Attributes:
        looks: Its parts, each with its faces, texture coordinates, subsets and materials.
    """

    looks: Sequence[Look]

    @classmethod
    def of_domain(
        cls,
        path: str | PathLike[str],
        loaded: LoadedMesh,
        bounds: npt.ArrayLike,
        offset: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> OwnSurface | None:
        """The surface from which a domain with these bounds [2, 3] [m] was made; its unit is the one that makes both
        equally large. None if they differ in more than size.

        Args:
            path: Path of the file.
            loaded: Its triangles, for files that hold nothing more.
            bounds: Bounds of the domain.
            offset: Translation of the domain [m], [3].

        Raises:
            InputError: See `look.read_looks`.
        """
        from warp_corot.io.read.usd.meshes import has_looks, look_of_triangles, read_looks

        looks = read_looks(path) if has_looks(path) else [look_of_triangles(path, loaded.points, loaded.cells)]
        moved = np.asarray(offset, dtype=np.float64)
        given = np.asarray(bounds, dtype=np.float64) - moved
        length = float(np.ptp(given, axis=0).max())
        # The whole file, or one part of it if it has several bodies.
        for some in (looks, *([look] for look in looks)):
            used = np.concatenate([look.points[look.triangles].reshape(-1, 3) for look in some])
            own = np.stack([used.min(axis=0), used.max(axis=0)])
            scale = length / max(float(np.ptp(own, axis=0).max()), 1e-300)
            if np.abs(scale * own - given).max() <= SAME * length:
                return cls(_outwards([look.placed(scale, moved) for look in some]))
        return None


@dataclass(frozen=True, eq=False)
class Skin:
    """A surface to draw.

    Attributes:
        name: "surface", or a label's name.
        surface: Bound to the nodes of the drawn mesh.
        look: The USD prim whose faces, texture coordinates and materials it keeps.
        is_boundary: Whether it contains the boundary of the mesh, which changes with the mesh.
        is_cut: Whether it is the body's own and becomes another one when the body is cut.
    """

    name: str
    surface: SurfaceMesh
    look: Look | None = None
    is_boundary: bool = False
    is_cut: bool = False

    @property
    def changes(self) -> bool:
        """Whether its triangles may change."""
        return self.is_boundary or self.is_cut

    def values(self, nodal: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """Nodal values [N] at the points of the surface, float32 [V]."""
        return np.einsum("vn,vn->v", self.surface.weights, nodal[self.surface.nodes]).astype(np.float32)


def has_domain(mesh: Any) -> bool:
    """Whether a mesh was made from a domain, so that the body ends within its tetrahedra."""
    return getattr(mesh, "phi", None) is not None


def has_labels(mesh: Any) -> bool:
    """Whether a mesh was made from a domain with labels."""
    return bool(getattr(mesh, "label_names", ()))


class BoundSkins:
    """The skins of bodies, bound again when a body's mesh has changed.

    Surfaces stay the same when the mesh changes: only the elements to which their points are bound change. The
    boundary of a mesh becomes that of the current one.

    Args:
        meshes: Forests or tetrahedral meshes, whose nodes are numbered one mesh after the other.
        surface: Drawn instead of the mesh's own: a bound surface, or a surface file whose parts are bound; for several
            meshes one each, None for the mesh's own.
        labels: Draw each label of a mesh as a separate closed surface.
        changing: Whether each mesh may change: surfaces given for such a mesh may be bound to an earlier one.
        are_cut: Whether they may be cut. The surface of a body then becomes that of its mesh.

    Raises:
        InputError: Surfaces that do not fit, or no mesh has labels; or bodies may be cut, and a surface is of a file,
            of labels, or of a body without a domain, so that it would not come apart.
    """

    def __init__(
        self,
        meshes: Sequence[Any],
        surface: Surface | Sequence[Surface | None] | None = None,
        labels: bool = False,
        changing: Sequence[bool] | None = None,
        are_cut: bool = False,
    ):
        given = _one_each(surface, len(meshes))
        if labels and not any(map(has_labels, meshes)):
            raise InputError("labels is True, but the mesh has none; it must be made from a domain with labels")
        if are_cut:
            for mesh, own in zip(meshes, given, strict=True):
                if labels or not (own is None or (isinstance(own, SurfaceMesh) and has_domain(mesh))):
                    what = "labels are drawn" if labels else "a surface is given"
                    raise InputError(f"{what}, but the body can be cut: only the surface of its mesh then comes apart")
        self._meshes = list(meshes)
        may_change = [False] * len(meshes) if changing is None else changing
        self._skins = [
            _skins_of_one(mesh, _rebound(own, mesh) if moves and isinstance(own, SurfaceMesh) else own, labels)
            for mesh, own, moves in zip(meshes, given, may_change, strict=True)
        ]
        if are_cut:
            self._skins = [[replace(skin, is_cut=True) for skin in own] for own in self._skins]

    def on(self, meshes: Sequence[Any]) -> list[Skin]:
        """The skins, bound to the nodes of the current meshes; skins with the same name are joined."""
        found, offset = [], 0
        for index, mesh in enumerate(meshes):
            if mesh is not self._meshes[index]:
                for place, skin in enumerate(self._skins[index]):
                    if skin.changes and mesh.tree.cut is not None:
                        surface = mesh.surface()
                    else:
                        surface = boundary_surface(mesh) if skin.is_boundary else _rebound(skin.surface, mesh)
                    self._skins[index][place] = replace(skin, surface=surface)
                self._meshes[index] = mesh
            for skin in self._skins[index]:
                nodes = (skin.surface.nodes + offset).astype(np.int32)
                found.append(replace(skin, surface=replace(skin.surface, nodes=nodes)))
            offset += len(mesh.points)
        return _joined(found)


def _one_each(surface: Any, count: int) -> list[Any]:
    if surface is None:
        return [None] * count
    several = isinstance(surface, Sequence) and not isinstance(surface, str | SurfaceMesh | OwnSurface)
    given = list(surface) if several else [surface]
    if len(given) != count:
        raise InputError(f"surface names {len(given)} surfaces; there must be one for each of the {count} bodies")
    return given


def _skins_of_one(mesh: Any, surface: Any, labels: bool) -> list[Skin]:
    if isinstance(surface, SurfaceMesh):
        lowest, highest, count = surface.nodes.min(initial=0), surface.nodes.max(initial=-1), len(mesh.points)
        if lowest < 0 or not 0 <= highest < count:
            raise InputError(
                f"the surface is bound to nodes {lowest} to {highest}, the mesh has nodes 0 to {count - 1}; it must be "
                "bound to this mesh"
            )
        return [Skin("surface", surface)]
    if isinstance(surface, OwnSurface):
        return _bound_looks(mesh, surface.looks)
    if isinstance(surface, str | PathLike):
        from warp_corot.io.read.usd.meshes import read_looks

        return _bound_looks(mesh, _outwards(read_looks(surface)))
    if surface is not None:
        raise InputError(f"surface is a {type(surface).__name__}; it must be a SurfaceMesh or a surface file")
    if labels and has_labels(mesh) and not has_domain(mesh):
        chosen = [(name, mesh.elements_of(name)) for name in mesh.label_names]
        return [Skin(name, boundary_surface(mesh, own)) for name, own in chosen if own.any()]
    if labels and has_labels(mesh):
        between = mesh.separating_surface()
        there = np.unique(between.sides)
        names = enumerate(mesh.label_names, start=1)
        return [Skin(name, between.of_label(number)) for number, name in names if number in there]
    if has_domain(mesh):
        return [Skin("surface", mesh.surface())]
    return [Skin("surface", boundary_surface(mesh), is_boundary=True)]


def _rebound(surface: SurfaceMesh, mesh: Any) -> SurfaceMesh:
    """The same points, bound to the elements of a forest that contain them."""
    bound = mesh.bind(surface.points)
    return replace(surface, nodes=bound.nodes, weights=bound.weights)


def _outwards(looks: Sequence[Look]) -> list[Look]:
    """The parts of a surface wound as the body that they enclose together."""
    firsts = np.cumsum([0, *(len(look.points) for look in looks)])
    triangles = [look.triangles + first for look, first in zip(looks, firsts, strict=False)]
    turned, is_open = turned_inwards(np.concatenate([look.points for look in looks]), np.concatenate(triangles))
    ends = np.cumsum([len(look.triangles) for look in looks])
    return [look.wound(own, is_open) for look, own in zip(looks, np.split(turned, ends[:-1]), strict=True)]


def _bound_looks(mesh: Any, looks: Sequence[Look]) -> list[Skin]:
    skins, low, high = [], mesh.points.min(axis=0), mesh.points.max(axis=0)
    body = float((high - low).max())
    for look in looks:
        size = float(np.ptp(look.points, axis=0).max())
        apart = (look.points.min(axis=0) > high).any() or (look.points.max(axis=0) < low).any()
        if apart or size > UNLIKELY * body:
            raise InputError(
                f"{look.source}: {look.path} is {size:.3g} m long and {'apart from' if apart else 'bound to'} the "
                f"body, which is {body:.3g} m long; is its metersPerUnit right?"
            )
        bound = mesh.bind(look.points)
        skins.append(Skin(look.name, SurfaceMesh(look.points, bound.nodes, bound.weights, look.triangles), look))
    return skins


def _joined(skins: Sequence[Skin]) -> list[Skin]:
    """Join skins with the same name, except those that keep a prim's look."""
    plain: dict[str, list[Skin]] = {}
    for skin in skins:
        if skin.look is None:
            plain.setdefault(skin.name, []).append(skin)
    whole = []
    for name, parts in plain.items():
        surface = joined_surfaces([part.surface for part in parts])
        flags = (any(part.is_boundary for part in parts), any(part.is_cut for part in parts))
        whole.append(Skin(name, surface, None, *flags))
    return whole + [skin for skin in skins if skin.look is not None]


def joined_surfaces(parts: Sequence[SurfaceMesh]) -> SurfaceMesh:
    """Surfaces bound to the nodes of one mesh as one."""
    if len(parts) == 1:
        return parts[0]
    firsts = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
    triangles = [part.triangles + first for part, first in zip(parts, firsts, strict=True)]
    return SurfaceMesh(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.nodes for part in parts]),
        np.concatenate([part.weights for part in parts]),
        np.concatenate(triangles).astype(np.int32),
        is_cut=np.concatenate([part.of_cut for part in parts]),
    )


# --- surfaces of rigid obstacles -------------------------------------------------------------------------------------

#: Points around a round shape.
AROUND = 32
#: Height of a drawn blade over the length of its edge.
BLADE_HEIGHT = 0.15
#: Half of the edge of a drawn ground, in sizes of the bodies on it.
GROUND_SIZE = 1.2

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Solid:
    """A surface in an obstacle's frame.

    Attributes:
        points: [m], [N, 3].
        triangles: Counter-clockwise seen from outside, int32 [F, 3].
    """

    points: Floats
    triangles: Ints

    def at(self, pose: npt.ArrayLike) -> Floats:
        """The points at a pose [m], [N, 3]: position and quaternion (x, y, z, w)."""
        place = np.asarray(pose, dtype=np.float64)
        return _rotation(place[3:]).apply(self.points) + place[:3]


def shape_of(obstacle: Obstacle) -> Shape:
    return obstacle.shape if isinstance(obstacle, Tool) else obstacle


def solid_of(shape: Shape) -> Solid | None:
    """The surface of a shape; None for a ground, which has no end, and for a signed distance."""
    if isinstance(shape, TriangleMesh):
        return Solid(np.asarray(shape.points, dtype=np.float64), np.asarray(shape.triangles, dtype=np.int32))
    if isinstance(shape, Edge):
        return _sheet(shape.points)
    if not isinstance(shape, Box | Sphere | Capsule | Cylinder):
        return None
    from trimesh import creation  # takes longer than ``import warp_corot``

    radius, half, _ = shape.size
    if isinstance(shape, Box):
        made = creation.box(extents=2.0 * np.array(shape.size))
    elif isinstance(shape, Sphere):
        made = creation.uv_sphere(radius=radius, count=[AROUND // 2 + 1, AROUND])
    elif isinstance(shape, Capsule):
        made = creation.capsule(radius=radius, height=2.0 * half, count=[AROUND // 2 + 1, AROUND])
    else:
        made = creation.cylinder(radius=radius, height=2.0 * half, sections=AROUND)
    return Solid(np.asarray(made.vertices, np.float64), np.asarray(made.faces, np.int32))


def ground_corners(ground: Ground, points: npt.ArrayLike) -> Floats:
    """A square of the ground below points [m], [4, 3], counter-clockwise seen from above."""
    x = np.asarray(points, dtype=np.float64)
    turn = _rotation(ground.quaternion)
    above = turn.inv().apply(x - ground.position)
    low, high = above.min(axis=0), above.max(axis=0)
    # A body that is higher than wide may fall over.
    center, half = 0.5 * (low + high)[:2], GROUND_SIZE * 0.5 * float((high - low).max())
    corners = np.array([(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)])
    return turn.apply(corners + np.array([*center, 0.0])) + ground.position


def poses_of(obstacles: Sequence[Obstacle], world: int = 0) -> Floats:
    """Where obstacles of a simulation are, float64 [O, 7]; waits for the device."""
    poses = [each.present_pose[world] if isinstance(each, Tool) else each.pose for each in obstacles]
    return np.array(poses, dtype=np.float64).reshape(-1, 7)


def _sheet(edge: Floats) -> Solid:
    """Both sides of a sheet behind a polyline [n, 3]."""
    along = edge[-1] - edge[0]
    aside = np.eye(3)[np.argmin(np.abs(along))]
    back = BLADE_HEIGHT * np.cross(np.cross(along, aside), along) / max(float(np.linalg.norm(along)), 1e-30)
    a, n = np.arange(len(edge) - 1), len(edge)
    front = np.concatenate([np.stack([a, a + 1, a + n + 1], axis=1), np.stack([a, a + n + 1, a + n], axis=1)])
    return Solid(np.concatenate([edge, edge + back]), np.concatenate([front, front[:, ::-1]]).astype(np.int32))


def _rotation(quaternion: npt.ArrayLike) -> Any:
    """SciPy's ``Rotation`` of a quaternion (x, y, z, w)."""
    from scipy.spatial.transform import Rotation  # takes a sixth of the time of ``import warp_corot``

    return Rotation.from_quat(quaternion)
