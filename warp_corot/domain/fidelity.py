"""Measurements of a body before it is meshed, and the fidelity of a mesh to it: volume, distances, pieces, labels,
shapes of elements."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from warp_corot.domain.closing import areas, net_edges
from warp_corot.domain.domain import Domain
from warp_corot.domain.labels import LabelDomain, piece_of_voxels
from warp_corot.domain.surface import SurfaceDomain
from warp_corot.domain.units import length, volume
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.surfaces.bound import distances_from
from warp_corot.mesh.topology import pieces_of, signed_volumes

if TYPE_CHECKING:
    from warp_corot.mesh import SurfaceMesh, TetForest, TetMesh

#: Number of points along the longest side at which a function is first evaluated, and of halvings of cells at the
#: surface.
CELLS, HALVINGS = 24, 2
#: Number of lines through a body that measure its volume, and the relative difference from its surface's volume above
#: which the surface overlaps itself.
LINES, COUNTED_TWICE = 60_000, 5.0e-3
#: Distance from a triangle at which the body's side is tested, over the body's length.
ASIDE = 1.0e-5


@dataclass(frozen=True)
class Reference:
    """The given body.

    Attributes:
        volume: [m^3].
        points: Points of its surface, evenly spread, float64 [n, 3] [m].
        piece: The connected piece of each point, int32 [n].
        pieces: Number of pieces.
    """

    volume: float
    points: np.ndarray
    piece: np.ndarray
    pieces: int


def reference_of(domain: Domain, count: int) -> Reference:
    """The measurements of a domain, without meshing it.

    Args:
        domain: Any domain. Results for surfaces and voxels are exact; for others volume and pieces come from samples.
        count: Approximate number of points.
    """
    if isinstance(domain, SurfaceDomain):
        return _of_surface(domain, count)
    if isinstance(domain, LabelDomain):
        return _of_voxels(domain, count)
    return _of_samples(domain, count)


def _of_surface(domain: SurfaceDomain, count: int) -> Reference:
    points, triangles = domain.closed.points, domain.closed.triangles.astype(np.int64)
    pieces, piece, crossing = domain.joined
    # At least one point of each piece, however small it is.
    spread, chosen = spread_points(points, triangles, count, np.unique(piece, return_index=True)[1])
    corners, own = points[triangles[chosen]], piece[chosen]
    volume = domain.closed.volume
    if crossing or domain.overlapping or domain.reversed:
        held = volume_along_lines(domain)
        crossing |= abs(held - volume) > COUNTED_TWICE * volume
        volume = held if crossing else volume
    if crossing:
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        aside = ASIDE * float(np.ptp(domain.bounds, axis=0).max()) * normal
        bounds = ~domain.holds(spread + aside) & domain.holds(spread - aside)
        spread, own = spread[bounds], own[bounds]
    return Reference(volume, spread, own, pieces)


def spread_points(
    points: np.ndarray, triangles: np.ndarray, count: int, first: Sequence[int] | np.ndarray = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Points evenly spread over triangles, float64 [n, 3], and the triangle of each; one in each of ``first``, too."""
    rng, area = np.random.default_rng(0), areas(points, triangles)
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    chosen = np.concatenate([np.asarray(first, chosen.dtype), chosen])
    u, v = np.sqrt(rng.random(len(chosen))), rng.random(len(chosen))
    weights = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)
    return np.einsum("nc,ncx->nx", weights, points[triangles[chosen]]), chosen


def volume_along_lines(domain: SurfaceDomain) -> float:
    """The volume of the body [m^3] by lines through it; regions where parts of its surface overlap count once."""
    lines, (low, high) = domain.lines, domain.bounds
    across = [(lines.axis + 1) % 3, (lines.axis + 2) % 3]
    size = (high - low)[across]
    counts = np.maximum(np.round(size * np.sqrt(LINES / size.prod())), 1).astype(int)
    cells = np.indices(counts).reshape(2, -1).T
    starts = np.empty((len(cells), 3))
    starts[:, across] = low[across] + (cells + np.random.default_rng(0).random(cells.shape)) * (size / counts)
    starts[:, lines.axis] = lines.low
    return float(domain.lengths_inside(starts).mean() * size.prod())


def _of_voxels(domain: LabelDomain, count: int) -> Reference:
    inside = domain.numbers > 0
    numbers = piece_of_voxels(inside)
    rng = np.random.default_rng(0)
    places, owner, weight = map(np.concatenate, zip(*_faces(domain, numbers), strict=True))
    first = np.unique(owner, return_index=True)[1]
    chosen = np.concatenate([first, rng.choice(len(places), count, p=weight / weight.sum())])
    spread = places[chosen] @ domain.affine[:3, :3].T + domain.affine[:3, 3]
    held = float(inside.sum()) * _voxel(domain)
    return Reference(held, spread, owner[chosen].astype(np.int32), int(numbers.max()))


def _voxel(domain: LabelDomain) -> float:
    """The volume of a voxel [m^3]."""
    return abs(float(np.linalg.det(domain.affine[:3, :3])))


def _faces(domain: LabelDomain, numbers: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Faces between a voxel inside and one outside, along each axis: their middles, in voxels, the pieces, of these
    numbers, to which they belong, and their areas [m^2]."""
    for axis in range(3):
        low, high = (np.moveaxis(numbers, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        faces = np.argwhere(np.moveaxis((low > 0) != (high > 0), 0, axis))
        owner = np.maximum(*(np.moveaxis(each, 0, axis)[tuple(faces.T)] for each in (low, high))) - 1
        area = _voxel(domain) / float(np.linalg.norm(domain.affine[:3, axis]))
        yield faces + 0.5 * np.eye(3)[axis], owner, np.full(len(faces), area)


def _of_samples(domain: Domain, count: int) -> Reference:
    volume, points, pieces = _sampled(domain)
    points = _projected(domain, points)
    if len(points) > count:
        points = points[np.random.default_rng(0).choice(len(points), count, replace=False)]
    return Reference(volume, points, np.zeros(len(points), np.int32), pieces)


def _sampled(domain: Domain) -> tuple[float, np.ndarray, int]:
    """Volume, points near the surface, and pieces, of cells that are halved where the surface may be."""
    low, size = domain.bounds[0], np.ptp(domain.bounds, axis=0)
    h = float(size.max()) / CELLS
    cells = np.maximum(np.ceil(size / h).astype(int), 1)
    centres = low + (np.indices(cells).reshape(3, -1).T + 0.5) * (size / cells)
    box = size / cells
    volume = 0.0
    for halving in range(HALVINGS + 1):
        phi = np.asarray(domain.phi(centres), np.float64)
        if halving == 0:
            pieces = scipy.ndimage.label((phi < 0.0).reshape(cells), np.ones((3, 3, 3)))[1]
        reach = 0.5 * domain.lipschitz * float(np.linalg.norm(box))
        near = np.abs(phi) <= reach
        volume += float((phi[~near] < 0.0).sum()) * float(box.prod())
        if halving == HALVINGS:
            # The filled fraction of the last cells comes from points in them, one in each eighth.
            rng = np.random.default_rng(0)
            eighths = (np.indices((2, 2, 2)).reshape(3, -1).T - 1.0)[None] + rng.random((int(near.sum()), 8, 3))
            within = centres[near][:, None] + 0.5 * eighths * box
            share = float((np.asarray(domain.phi(within.reshape(-1, 3))) < 0.0).mean())
            return volume + share * float(near.sum()) * float(box.prod()), centres[near], max(int(pieces), 1)
        parts = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * 0.5
        centres = (centres[near][:, None] + parts * box).reshape(-1, 3)
        box = 0.5 * box
    raise AssertionError


def _projected(domain: Domain, points: np.ndarray) -> np.ndarray:
    """Points near the surface, moved onto it."""
    size = float(np.ptp(domain.bounds, axis=0).max())
    step = 1.0e-4 * size
    for _ in range(4):
        phi = np.asarray(domain.phi(points), np.float64)
        slopes = [domain.phi(points + step * axis) - domain.phi(points - step * axis) for axis in np.eye(3)]
        gradient = np.stack(slopes, axis=1).astype(np.float64) / (2.0 * step)
        points = points - (phi / np.maximum((gradient**2).sum(axis=1), 0.05))[:, None] * gradient
    return points[np.abs(domain.phi(points)) < 1.0e-3 * size / CELLS]


def extent_of(domain: Domain) -> tuple[float, float]:
    """Approximate volume [m^3] and surface area [m^2] of a domain."""
    if isinstance(domain, SurfaceDomain):
        return domain.closed.volume, float(areas(domain.closed.points, domain.closed.triangles).sum())
    if isinstance(domain, LabelDomain):
        inside = domain.numbers > 0
        # A staircase has about 1.5 times the area of the slope that it represents.
        return float(inside.sum()) * _voxel(domain), sum(own.sum() for *_, own in _faces(domain, inside)) / 1.5
    volume, points, _ = _sampled(domain)
    # The layer of cells near the surface is as thick as their diagonal on both sides.
    cell = float(np.ptp(domain.bounds, axis=0).max()) / CELLS * 0.5**HALVINGS
    return volume, len(points) * cell**3 / (domain.lipschitz * np.sqrt(3.0) * cell)


#: Sample points on each of the two surfaces.
SAMPLES = 20_000
#: A relative error of the volume, or of a label's, above this draws a warning.
LARGEST_VOLUME_ERROR, LARGEST_LABEL_ERROR = 0.03, 0.05


@dataclass(frozen=True)
class LabelFidelity:
    """A label of a mesh compared with that of the scan.

    Attributes:
        name: Its name.
        volume: Volume of the body inside its elements [m^3].
        input_volume: Volume of its voxels [m^3].
        elements: Number of its elements.
    """

    name: str
    volume: float
    input_volume: float
    elements: int

    @property
    def error(self) -> float:
        """The excess volume of the mesh, as a share of the scan's."""
        return self.volume / self.input_volume - 1.0


@dataclass(frozen=True)
class Fidelity:
    """A mesh compared with the body that it was made from. Lengths [m], volumes [m^3], angles [°].

    Attributes:
        volume: Volume of the body inside the elements.
        input_volume: Volume of the given body.
        distance_mean: Mean distance of the mesh's surface from the given one, and of the given one from the mesh's.
        distance_95: The 95th percentiles of the same distances.
        pieces: Number of pieces of the mesh; elements that share a face belong to one piece.
        input_pieces: Number of pieces of the given body. Parts of a surface that touch, cross or contain one another
            are one piece, and so are voxels that touch, even in a corner.
        lost_pieces: Pieces of the body that are in no element.
        labels: The labels of a scan, without those that no element has.
        lost_labels: Names of labels that no element has.
        watertight: Whether every edge of the mesh's surface is used once in each direction.
        smallest_dihedral: The sharpest angle between two faces of an element.
        elements: Number of elements.
    """

    volume: float
    input_volume: float
    distance_mean: tuple[float, float]
    distance_95: tuple[float, float]
    pieces: int
    input_pieces: int
    lost_pieces: int
    labels: tuple[LabelFidelity, ...]
    lost_labels: tuple[str, ...]
    watertight: bool
    smallest_dihedral: float
    elements: int

    @property
    def volume_error(self) -> float:
        """The excess volume of the mesh, as a share of the body's."""
        return self.volume / self.input_volume - 1.0

    def report(self) -> list[str]:
        """The measurements, line by line."""
        (there, back), (far, far_back) = self.distance_mean, self.distance_95
        return [
            f"volume {volume(self.volume)} of {volume(self.input_volume)} ({self.volume_error:+.2%})",
            f"surface {length(there)} from the input's on average, 95 % within {length(far)}; "
            f"the input's from it {length(back)}, {length(far_back)}",
            f"pieces {self.pieces}, of the input {self.input_pieces}"
            + (f"; labels lost: {', '.join(self.lost_labels)}" if self.lost_labels else ""),
            *(f"label {x.name}: {volume(x.volume)} of {volume(x.input_volume)} ({x.error:+.2%})" for x in self.labels),
        ]

    def doubts(self) -> list[str]:
        """Defects and their remedies, a line each; empty if the mesh is good."""
        found = []
        if abs(self.volume_error) > LARGEST_VOLUME_ERROR:
            found.append(
                f"the tetrahedra hold {self.volume_error:+.1%} of the body's volume; more tetrahedra would help"
            )
        if self.lost_pieces:
            found.append(
                f"{self.lost_pieces} of the body's {self.input_pieces} pieces are in no tetrahedron; more tetrahedra "
                "would help"
            )
        if self.pieces > self.input_pieces - self.lost_pieces:
            found.append(
                f"the body has {self.input_pieces} piece{'s'[: self.input_pieces != 1]} and the mesh {self.pieces}: "
                "something thin is broken; more tetrahedra would help"
            )
        if self.pieces < self.input_pieces - self.lost_pieces:
            found.append(
                f"the body has {self.input_pieces} pieces and the mesh {self.pieces}: pieces closer to one another "
                "than a tetrahedron have grown together; more tetrahedra would help, or a file or object of its own "
                "for each piece, which then is a body of its own"
            )
        for label in self.labels:
            if abs(label.error) > LARGEST_LABEL_ERROR:
                found.append(
                    f"label {label.name}: its volume is {label.error:+.1%} off in its {label.elements} tetrahedra; "
                    "more tetrahedra would help"
                )
        if self.lost_labels:
            found.append(
                f"no tetrahedron has the label{'s'[: len(self.lost_labels) != 1]} {', '.join(self.lost_labels)}: "
                "smaller than one; more of them would help"
            )
        return found


def fidelity(
    mesh: TetForest | TetMesh,
    surface_or_domain: Any,
    *,
    surface: SurfaceMesh | None = None,
    samples: int = SAMPLES,
) -> Fidelity:
    """Measure the fidelity of a mesh to the body that it was made from.

    Args:
        mesh: A forest or a mesh of any tetrahedra.
        surface_or_domain: A domain, or an argument of `Domain.from_surface`: a file or (points [N, 3] [m], triangles).
        surface: The mesh's surface; None: its marched surface, or its boundary if it has none.
        samples: Sample points on each of the two surfaces.

    Raises:
        InputError: The surface encloses nothing.
    """
    domain = surface_or_domain if isinstance(surface_or_domain, Domain) else Domain.from_surface(surface_or_domain)
    given = reference_of(domain, samples)
    if surface is None:
        surface = mesh.surface() if hasattr(mesh, "surface") else boundary_surface(mesh)
    forth = np.abs(np.asarray(domain.phi(spread_points(surface.points, surface.triangles, samples)[0]), np.float64))
    back = distances_from(surface.points, surface.triangles, given.points, 1.0e15, domain.device).astype(np.float64)
    lost = tuple(n for n in domain.label_names if not (n in _labels(mesh) and mesh.elements_of(n).any()))
    return Fidelity(
        volume=float(held_volumes(mesh).sum()),
        input_volume=given.volume,
        distance_mean=(float(forth.mean()), float(back.mean())),
        distance_95=(float(np.quantile(forth, 0.95)), float(np.quantile(back, 0.95))),
        pieces=int(pieces_of(mesh.tets).max()) + 1,
        input_pieces=given.pieces,
        lost_pieces=_lost_pieces(mesh, given.points, given.piece, back),
        labels=tuple(_of_labels(mesh, domain)),
        lost_labels=lost,
        watertight=not len(net_edges(surface.triangles.astype(np.int64))[0]),
        smallest_dihedral=smallest_dihedral(mesh),
        elements=len(mesh.tets),
    )


def mesh_volumes(mesh: TetForest | TetMesh) -> np.ndarray:
    """Volumes of a mesh's elements [m^3]."""
    volumes = getattr(mesh, "volumes", None)
    return np.abs(signed_volumes(mesh.points, mesh.tets)) if volumes is None else volumes


def held_volumes(mesh: TetForest | TetMesh) -> np.ndarray:
    """Volumes of a mesh's elements [m^3]; elements that a surface cuts count with the part inside."""
    volumes, fill = mesh_volumes(mesh), getattr(mesh, "fill", None)
    return volumes if fill is None else volumes * fill


def _of_labels(mesh: TetForest | TetMesh, domain: Domain) -> Iterator[LabelFidelity]:
    volumes = held_volumes(mesh)
    for name, wanted in zip(domain.label_names, domain.label_volumes.tolist(), strict=True):
        own = mesh.elements_of(name) if name in _labels(mesh) and wanted > 0.0 else np.zeros(len(volumes), bool)
        if not own.any():
            continue
        yield LabelFidelity(name, float(volumes[own].sum()), wanted, int(own.sum()))


def smallest_dihedral(mesh: TetForest | TetMesh) -> float:
    """The sharpest angle between two faces of an element [°]."""
    tets = mesh.tets
    if hasattr(mesh, "levels"):
        # A forest has three shapes.
        tets = tets[np.unique(mesh.levels % 3, return_index=True)[1]]
    smallest = np.pi
    for part in np.array_split(tets, len(tets) // 200_000 + 1):
        x = mesh.points[part]
        normals = []
        for opposite in range(4):
            a, b, c = (x[:, n] for n in range(4) if n != opposite)
            normal = np.cross(b - a, c - a)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
            towards = np.einsum("ij,ij->i", normal, x[:, opposite] - a)
            normals.append(np.where(towards > 0, -1.0, 1.0)[:, None] * normal)
        for one, other in itertools.combinations(normals, 2):
            cosine = np.einsum("ij,ij->i", one, other)
            smallest = min(smallest, float(np.pi - np.arccos(np.clip(cosine, -1.0, 1.0)).max()))
    return float(np.degrees(smallest))


def _labels(mesh: Any) -> tuple[str, ...]:
    return tuple(getattr(mesh, "label_names", ()))


def _lost_pieces(mesh: Any, points: np.ndarray, piece: np.ndarray, distances: np.ndarray) -> int:
    """Pieces of the body with no point in an element."""
    near = np.unique(piece, return_index=True)[1]
    if not hasattr(mesh, "embed") or len(near) == 1:
        return 0
    _, weights = mesh.embed(points)
    held = weights.min(axis=1) > -1.0e-6
    return len(near) - len(np.unique(piece[held]))
