"""The fidelity of a mesh to its body: volume, distances, pieces, labels, shapes of elements."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.domain.closing import net_edges
from warp_corot.domain.domain import Domain
from warp_corot.domain.reference import reference_of, spread_points
from warp_corot.domain.units import length, volume
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.surfaces.bound import distances_from
from warp_corot.mesh.topology import pieces_of, signed_volumes

if TYPE_CHECKING:
    from warp_corot.mesh import SurfaceMesh, TetForest, TetMesh

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
