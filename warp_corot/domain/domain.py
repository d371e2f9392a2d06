"""Domains: bodies as signed functions, sampled on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.device import checked_device
from warp_corot.kernels.meshing import domain as kernels

from .units import check_float32, length

if TYPE_CHECKING:
    from warp_corot.io.read.surfaces import LoadedSurface
    from warp_corot.io.read.volumes import LoadedVolume

    Surface = str | PathLike[str] | LoadedSurface | tuple[npt.ArrayLike, npt.ArrayLike]
    Volume = str | PathLike[str] | LoadedVolume | npt.ArrayLike
    # Or a Warp function, which type checkers do not know.
    Function = Callable[[np.ndarray], npt.ArrayLike]

#: The shortest step inwards when a body's thickness is sought, over how far it is sought, and how many there are.
SPHERE_STEP = 0.04
SPHERES = 25


class Domain:
    """A body as a signed function phi [m], negative inside.

    Made by `from_surface`, `from_labels`, `from_probabilities`, `from_function`, by the shapes `sphere`, `box`, `torus`
    and `capsule`, and from other domains: ``a | b`` (union), ``a & b`` (intersection), ``a - b`` (difference).

    Attributes:
        bounds: Axis-aligned box that holds the inside [m], float64 [2, 3].
        lipschitz: |phi(a) - phi(b)| <= lipschitz * |a - b| for all points a and b, up to float32's rounding: where
            |phi| > lipschitz * r no surface is nearer than r.
        up_axis: "X", "Y" or "Z".
        label_names: Names of the labels, () without any.
        device: Where points that are given as NumPy arrays are evaluated.
    """

    def __init__(
        self,
        bounds: npt.ArrayLike,
        lipschitz: float,
        *,
        up_axis: str = "Y",
        label_names: Sequence[str] = (),
        device: str | wp.Device | None = None,
    ):
        if up_axis not in ("X", "Y", "Z"):
            raise InputError(f"up_axis is {up_axis!r}; it must be 'X', 'Y' or 'Z'")
        self.bounds = np.array(bounds, dtype=np.float64)
        check_float32(self.bounds)
        self.lipschitz = float(lipschitz)
        self.up_axis = up_axis
        self.label_names = tuple(label_names)
        self.device = checked_device(device)

    def phi(self, points: Any) -> Any:
        """The signed function [m], negative inside.

        Args:
            points: Positions [m]: an array [n, 3], or a Warp array of vec3.

        Returns:
            float32 [n]: NumPy's for NumPy's, Warp's on the same device for Warp's.

        Raises:
            InputError: NumPy points of another shape, or not finite.
        """
        if isinstance(points, wp.array):
            return self._phi(points)
        return self._phi(self._on_device(points)).numpy()

    def labels_at(self, points: Any, *, nearest: bool = False) -> Any:
        """Which label holds each point.

        Args:
            points: As for `phi`.
            nearest: Points outside the body, and in gaps between labels, take the nearest label instead of 0.

        Returns:
            int32 [n], as for `phi`: the label's place in ``label_names`` plus one; 0 outside any.
        """
        given = points if isinstance(points, wp.array) else self._on_device(points)
        if self.label_names:
            labels = self._labels(given)
            if not nearest:
                wp.launch(kernels.clear_labels_outside, given.size, [self._phi(given)], [labels], device=given.device)
        else:
            labels = wp.zeros(given.size, wp.int32, device=given.device)
        return labels if isinstance(points, wp.array) else labels.numpy()

    #: Whether the body has, or may have, several pieces, which are not to grow together.
    has_pieces = False

    def thickness(
        self, points: npt.ArrayLike, inward: npt.ArrayLike, reach: float, *, outside: bool = False
    ) -> np.ndarray:
        """How thick the body is at points of its surface: how far it is to where one leaves it again.

        Args:
            points: On the surface, or nearly [n, 3] [m].
            inward: Unit vectors [n, 3].
            reach: What is thicker counts as this thick [m].
            outside: The same of what is around the body, outwards: how wide gaps are.

        Returns:
            float64 [n] [m].
        """
        side = -1.0 if outside else 1.0
        given, directions = self._on_device(points), self._on_device(side * np.asarray(inward))
        return self._thickness(given, directions, float(reach), side).astype(np.float64)

    def part(self, name: str) -> Domain:
        """The domain of one label alone.

        Raises:
            InputError: No such label; the message lists those there are.
        """
        there = ", ".join(self.label_names) or "none"
        raise InputError(f"there is no label {name!r} in this domain; its labels: {there}")

    def named(self, name: str) -> Domain:
        """The same body, all of it one label of that name.

        In a union, the label of the first domain that holds a point counts: ``tumour.named("tumour") | liver``.
        """
        from .combined import NamedDomain

        return NamedDomain(self, name)

    def report(self) -> list[str]:
        """What a user should know of it, line by line: size, unit, how closed, pieces, labels."""
        low, high = self.bounds
        size = " x ".join(length(side) for side in high - low)
        lines = [f"bounds {size}, {self.up_axis} up", *self._details()]
        if self.label_names:
            lines.append(f"labels: {', '.join(self.label_names)}")
        return lines

    def __or__(self, other: Domain) -> Domain:
        from .combined import Union

        return Union(self, other) if isinstance(other, Domain) else NotImplemented

    def __and__(self, other: Domain) -> Domain:
        from .combined import Intersection

        return Intersection(self, other) if isinstance(other, Domain) else NotImplemented

    def __sub__(self, other: Domain) -> Domain:
        from .combined import Difference

        return Difference(self, other) if isinstance(other, Domain) else NotImplemented

    def point_in(self, name: str) -> np.ndarray | None:
        """A point where a label is [m], float64 [3]; None where none is known without looking for it."""
        return None

    # What a kind of domain defines.

    def _phi(self, points: wp.array) -> wp.array:
        """float32 [n] on the points' device."""
        raise NotImplementedError

    def _labels(self, points: wp.array) -> wp.array:
        """Labels int32 [n] on the points' device; outside the body those of the nearest part."""
        raise NotImplementedError

    def _thickness(self, points: wp.array, along: wp.array, reach: float, side: float) -> np.ndarray:
        """float32 [n]; of the body for a ``side`` of 1, of what is around it for -1.

        Here by spheres: as far on as no surface can be, again and again.
        """
        start, along = points.numpy(), along.numpy()
        gone = np.full(len(start), SPHERE_STEP * reach, np.float32)
        going = np.arange(len(start))
        for _ in range(SPHERES):
            phi = side * self.phi(start[going] + gone[going, None] * along[going])
            inside = phi < 0.0
            going, step = going[inside], np.abs(phi[inside]) / self.lipschitz
            gone[going] += np.maximum(step, SPHERE_STEP * reach)
            going = going[gone[going] < reach]
            if not len(going):
                break
        return np.minimum(gone, reach)

    def _details(self) -> list[str]:
        return []

    def _on_device(self, points: npt.ArrayLike) -> wp.array:
        given = np.asarray(points)
        if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "fiu":
            raise InputError(f"points have shape {given.shape} and dtype {given.dtype}; they must be numbers [n, 3]")
        bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
        if len(bad):
            raise InputError(f"point {bad[0]} is {given[bad[0]].tolist()}; its coordinates must be finite")
        return wp.array(np.ascontiguousarray(given, dtype=np.float32), dtype=wp.vec3, device=self.device)

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
        """What a closed triangle surface encloses.

        The distance to the surface is exact; a point is inside where the winding number is above one half (Jacobson,
        Kavan and Sorkine-Hornung 2013, by Warp's meshes). Before that, triangles wound against their neighbours are
        turned round, parts that are inside out too, and holes are closed by cones over their rims. How open the surface
        was is reported. Parts that overlap count as one body, a part inside another and wound inwards as a cavity.

        Args:
            surface: A file (.obj .stl .ply .off .glb .gltf through trimesh, USD, or one of the formats of
                `warp_corot.io.read` with triangles alone), ``warp:bunny``, what `load_surface` gives, or points [N, 3]
                and triangles [T, 3].
            unit: Of the coordinates, any length such as "mm", "inch" or "3.2cm". None: what the file says, metres if
                it says nothing.
            up_axis: "X", "Y" or "Z". None: what the file says; if it says nothing Y, for .stl, .ply and .off Z.
            device: Where it is evaluated; None: Warp's default.

        Raises:
            InputError: Not a surface, or none that encloses a body: open for more than a third of its area, of zero
                thickness, or crossing itself so that part of the body is inside out.

        Warns:
            UserWarning: A body longer than 100 m or shorter than 1 mm, or a surface whose holes are more than one per
                cent of its area.
        """
        from .surface import surface_domain

        return surface_domain(surface, unit, up_axis, device)

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
        """The voxels of a segmented volume that bear certain labels.

        phi is, at voxel centres, the Euclidean distance to the nearest centre on the other side less half a step, and
        trilinear between them: the surface lies halfway between neighbours inside and outside. Beyond the volume is
        outside; more than two voxels outside the body's box, phi is a lower bound of the distance.

        Args:
            volume: Whole numbers [nx, ny, nz], what `load_volume` gives, or a file: .nii, .nii.gz, .mgz (nibabel),
                .mha, .mhd, .nrrd (SimpleITK), .vti (VTK), or a folder with a DICOM series. Positions are the file's
                own, in the directions right-anterior-superior where the format names directions.
            spacing: Distance of voxel centres along the three axes, in ``unit``; needed for an array.
            origin: Position of the centre of voxel (0, 0, 0), in ``unit``; None: the origin.
            affine: Instead of spacing and origin: the matrix [4, 4] from voxel indices to positions in ``unit``. It
                may turn, mirror and shear.
            labels: The numbers of each named label. None: all numbers but 0, each named by itself.
            unit: Any length such as "mm" or "3.2cm". None: what a file says (an error where it says nothing); metres
                for an array.
            smoothing: Standard deviation [m] of a Gaussian by which phi is smoothed: takes the steps of the voxels
                off, and details of this size with them. What it does to the volume is reported.
            up_axis: "X", "Y" or "Z".
            device: Where it is evaluated; None: Warp's default.

        Raises:
            InputError: Not a label volume, empty, not whole or not finite numbers, no spacing, no unit, or a label
                that it does not have; the message lists those it has.

        Warns:
            UserWarning: A body longer than 100 m or shorter than 1 mm.
        """
        from .labels import label_domain

        return label_domain(volume, spacing, origin, affine, labels, unit, smoothing, up_axis, device)

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
        """The body that probability maps make: each voxel takes the likeliest label, see `labels_from_probabilities`.

        Args:
            maps: Volumes or files, all of one shape and place, by label name.
            certain: The value that means probability one: 255 for maps in bytes.
            spacing, origin, affine, unit, smoothing, up_axis, device: As for `from_labels`.

        Raises:
            InputError: Maps of different shapes or places, values outside 0 to ``certain``, or as for `from_labels`.
        """
        from .labels import probability_domain

        return probability_domain(maps, certain, spacing, origin, affine, unit, smoothing, up_axis, device)

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
        """Where a function is negative, within a box.

        Args:
            function: A NumPy function float64 [n, 3] -> [n], or a Warp function (``wp.func``) vec3 -> float, which is
                evaluated on the device.
            bounds: Lowest and highest corner of a box [2, 3] [m]; the body is cut off there.
            lipschitz: How much the function changes per metre, at most.
            up_axis: "X", "Y" or "Z".
            device: Where it is evaluated; None: Warp's default.

        Raises:
            InputError: An empty box, a function of another form or not finite in the box, or one that was seen to
                change faster than ``lipschitz`` says.
        """
        from .function import FunctionDomain

        return FunctionDomain(function, bounds, lipschitz, up_axis=up_axis, device=device)

    @classmethod
    def sphere(cls, radius: float, centre: Sequence[float] = (0.0, 0.0, 0.0), **options: Any) -> Domain:
        """A ball [m]. Options here and below: ``up_axis``, ``device``."""
        from .shapes import Sphere

        return Sphere(radius, centre, **options)

    @classmethod
    def box(cls, lower: Sequence[float], upper: Sequence[float], **options: Any) -> Domain:
        """An axis-aligned box between two corners [m]."""
        from .shapes import Box

        return Box(lower, upper, **options)

    @classmethod
    def torus(
        cls, major: float, minor: float, centre: Sequence[float] = (0.0, 0.0, 0.0), axis: str = "Z", **options: Any
    ) -> Domain:
        """A ring: a tube of radius ``minor`` around a circle of radius ``major`` [m] about an axis."""
        from .shapes import Torus

        return Torus(major, minor, centre, axis, **options)

    @classmethod
    def capsule(cls, start: Sequence[float], end: Sequence[float], radius: float, **options: Any) -> Domain:
        """All points within ``radius`` of the segment between two points [m]."""
        from .shapes import Capsule

        return Capsule(start, end, radius, **options)
