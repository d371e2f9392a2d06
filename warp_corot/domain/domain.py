"""Domains: bodies as users make and combine them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy.typing as npt
import warp as wp

from warp_corot.inputs.arguments import forwards

from . import shapes
from .shapes import DifferenceDomain, Function, FunctionDomain, IntersectionDomain, NamedDomain, UnionDomain
from .signed import SignedFunction

if TYPE_CHECKING:
    from .labels import Volume
    from .surface import Surface


class Domain(SignedFunction):
    """A body as a signed function phi [m], negative inside.

    Made by `from_surface`, `from_labels`, `from_probabilities`, `from_function`, by the shapes `sphere`, `box`, `torus`
    and `capsule`, and from other domains: ``a | b`` (union), ``a & b`` (intersection), ``a - b`` (difference).

    Attributes:
        bounds: Axis-aligned box that holds the inside [m], float64 [2, 3].
        lipschitz: |phi(a) - phi(b)| <= lipschitz * |a - b| for all points a and b, up to float32's rounding: where
            |phi| > lipschitz * r no surface is nearer than r.
        up_axis: "X", "Y" or "Z".
        label_names: Names of the labels, () without any.
        device: The device that evaluates points given as NumPy arrays.
    """

    def part(self, name: str) -> Domain:
        """The domain of a single label.

        Raises:
            InputError: The domain has no label of this name; the message lists its labels.
        """
        return _Made(super().part(name))

    def named(self, name: str) -> Domain:
        """The same body, with one label of that name everywhere.

        In a union, the label of the first domain that holds a point counts: ``tumour.named("tumour") | liver``.
        """
        return _Made(NamedDomain(self, name))

    def __or__(self, other: Domain) -> Domain:
        return _Made(UnionDomain(self, other)) if isinstance(other, Domain) else NotImplemented

    def __and__(self, other: Domain) -> Domain:
        return _Made(IntersectionDomain(self, other)) if isinstance(other, Domain) else NotImplemented

    def __sub__(self, other: Domain) -> Domain:
        return _Made(DifferenceDomain(self, other)) if isinstance(other, Domain) else NotImplemented

    # Ways to make one.

    @classmethod
    def from_surface(
        cls,
        surface: Surface,
        *,
        unit: str | float | None = None,
        up_axis: str | None = None,
        device: str | wp.Device | None = None,
    ) -> Domain:
        """The body that a closed triangle surface encloses.

        The distance to the surface is exact; a point is inside if the winding number is above one half (Jacobson,
        Kavan and Sorkine-Hornung 2013, by Warp's meshes). Before that, points in one place are welded, triangles that
        are there twice count once, triangles wound against their neighbours and parts that are inside out are reversed,
        and holes are closed by cones over their rims. The report says what was repaired, and how open the surface was.
        Parts that overlap count as one body; a part inside another that is wound inwards is a cavity.

        Args:
            surface: A file (.obj .stl .ply .off .glb .gltf through trimesh, USD, or one of the formats of
                `warp_corot.io.read` with triangles only), ``warp:bunny``, the result of `load_surface`, or points
                [N, 3] and triangles [T, 3].
            unit: The unit of the coordinates, any length such as "mm", "inch" or "3.2cm". None: the file's unit, or
                metres.
            up_axis: "X", "Y" or "Z". None: the file's axis; without one Z for .stl, .ply and .off, and Y for others.
            device: The device that evaluates it; None: Warp's default.

        Raises:
            InputError: The argument is not a surface, or encloses no body: more than a third of its area is open or
                walls inside it, it has zero thickness, or it crosses itself so that part of the body is inside out.

        Warns:
            UserWarning: The body is longer than 3 m or shorter than 1 mm and no unit was given, or holes are more than
                one per cent of the surface's area.
        """
        from .surface import surface_domain

        return _Made(surface_domain(surface, unit, up_axis, device))

    @classmethod
    def from_labels(
        cls,
        volume: Volume,
        spacing: Sequence[float] | None = None,
        *,
        origin: Sequence[float] | None = None,
        affine: npt.ArrayLike | None = None,
        labels: Mapping[str, int | Sequence[int]] | None = None,
        unit: str | float | None = None,
        smoothing: float = 0.0,
        up_axis: str = "Z",
        device: str | wp.Device | None = None,
    ) -> Domain:
        """The voxels of a segmented volume with certain labels.

        At voxel centres, phi is the Euclidean distance to the nearest centre on the other side minus half a step, and
        trilinear in between: the surface lies halfway between neighbours inside and outside. Points beyond the volume
        are outside; more than two voxels outside the body's box, phi is a lower bound of the distance.

        Args:
            volume: Whole numbers [nx, ny, nz], the result of `load_volume`, or a file: .nii, .nii.gz, .mha, .mhd,
                .nrrd (SimpleITK), .vti (VTK), or a folder with a DICOM series. Positions are the file's
                own, with axes right-anterior-superior if the format names directions.
            spacing: Distance of voxel centres along the three axes, in ``unit``; needed for an array.
            origin: Position of the centre of voxel (0, 0, 0), in ``unit``; None: the origin.
            affine: In place of spacing and origin: the matrix [4, 4] from voxel indices to positions in ``unit``. It
                may rotate, mirror and shear.
            labels: The numbers of each named label. None: all numbers but 0, each named by its number.
            unit: Any length such as "mm" or "3.2cm". None: the file's unit (an error if it has none); metres for an
                array.
            smoothing: Standard deviation [m] of a Gaussian that smooths phi. It removes the steps of the voxels, and
                details of this size. The report says how it changes the volume.
            up_axis: "X", "Y" or "Z".
            device: The device that evaluates it; None: Warp's default.

        Raises:
            InputError: The argument is not a label volume, is empty, has values that are not whole or finite, has no
                spacing or no unit, or does not have a label; the message lists the labels that exist.

        Warns:
            UserWarning: The body is longer than 3 m or shorter than 1 mm, and no unit was given.
        """
        from .labels import label_domain

        return _Made(label_domain(volume, labels, (spacing, origin, affine, unit), smoothing, up_axis, device))

    @classmethod
    def from_probabilities(
        cls,
        maps: Mapping[str, Volume],
        spacing: Sequence[float] | None = None,
        *,
        certain: float = 1.0,
        origin: Sequence[float] | None = None,
        affine: npt.ArrayLike | None = None,
        unit: str | float | None = None,
        smoothing: float = 0.0,
        up_axis: str = "Z",
        device: str | wp.Device | None = None,
    ) -> Domain:
        """A body from probability maps: each voxel has the likeliest label; see `labels_from_probabilities`.

        Args:
            maps: Volumes or files by label name, all with the same shape and place.
            certain: The value that means probability one: 255 for maps of bytes.
            spacing, origin, affine, unit, smoothing, up_axis, device: As for `from_labels`.

        Raises:
            InputError: The maps have different shapes or places, a value is outside 0 to ``certain``, or as for
                `from_labels`.
        """
        from .labels import probability_domain

        return _Made(probability_domain(maps, certain, (spacing, origin, affine, unit), smoothing, up_axis, device))

    @classmethod
    def from_function(
        cls,
        function: Function,
        bounds: npt.ArrayLike,
        lipschitz: float = 1.0,
        *,
        up_axis: str = "Y",
        device: str | wp.Device | None = None,
    ) -> Domain:
        """The points of a box at which a function is negative.

        Args:
            function: A NumPy function float64 [n, 3] -> [n], or a Warp function (``wp.func``) vec3 -> float, which is
                evaluated on the device.
            bounds: Lowest and highest corner of a box [2, 3] [m], which cuts off the body.
            lipschitz: The most that the function changes per metre.
            up_axis: "X", "Y" or "Z".
            device: The device that evaluates it; None: Warp's default.

        Raises:
            InputError: The box is empty, the function has another form, is not finite in the box, or changes faster
                than ``lipschitz`` says.
        """
        return _Made(FunctionDomain(function, bounds, lipschitz, up_axis=up_axis, device=device))

    @classmethod
    def sphere(cls, radius: float, centre: Sequence[float] = (0.0, 0.0, 0.0), **options: Any) -> Domain:
        """A ball [m]. Options here and below: ``up_axis``, ``device``."""
        return _Made(shapes.sphere(radius, centre, **options))

    @classmethod
    def box(cls, lower: Sequence[float], upper: Sequence[float], **options: Any) -> Domain:
        """An axis-aligned box between two corners [m]."""
        return _Made(shapes.box(lower, upper, **options))

    @classmethod
    def torus(
        cls, major: float, minor: float, centre: Sequence[float] = (0.0, 0.0, 0.0), axis: str = "Z", **options: Any
    ) -> Domain:
        """A ring: a tube of radius ``minor`` around a circle of radius ``major`` [m] about an axis."""
        return _Made(shapes.torus(major, minor, centre, axis, **options))

    @classmethod
    def capsule(cls, start: Sequence[float], end: Sequence[float], radius: float, **options: Any) -> Domain:
        """All points within ``radius`` of the segment between two points [m]."""
        return _Made(shapes.capsule(start, end, radius, **options))


@forwards("kind", "has_pieces", "holds", "exits", "points_in", "label_volumes")
@forwards("kind", "_phi", "_labels", "_thickness", "_details")
class _Made(Domain):
    """A signed function of any kind, as a user holds it."""

    def __init__(self, kind: SignedFunction):
        options: dict[str, Any] = {"up_axis": kind.up_axis, "label_names": kind.label_names, "device": kind.device}
        super().__init__(kind.bounds, kind.lipschitz, **options)
        self._kind = kind

    def __getattr__(self, name: str) -> Any:
        """Attributes of one kind only, such as ``numbers`` and ``affine`` of voxels and ``closed`` of a surface."""
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
        return getattr(self._kind, name)

    @property
    def kind(self) -> SignedFunction:
        return self._kind

    def part(self, name: str) -> Domain:
        return _Made(self._kind.part(name))
