"""Bodies as users make and combine them: signed functions, sampled on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import (
    checked_axis,
    checked_device,
    checked_length,
    checked_numbers,
    checked_points,
    checked_strings,
    shown,
)
from warp_corot.kernels.meshing import domain as kernels

from .units import check_float32, length

if TYPE_CHECKING:
    from .labels import Volume
    from .surface import Surface

#: A user's function or a Warp function; type checkers do not know the latter's type.
Function = Callable[[np.ndarray], npt.ArrayLike]

#: The shortest step inwards in the search for a body's thickness, relative to its range, and the number of steps.
SPHERE_STEP = 0.04
SPHERES = 25
#: Four directions whose differences give a gradient.
_AROUND = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / np.sqrt(3.0)


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
        device: The device that evaluates points given as NumPy arrays.
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
        checked_axis(up_axis)
        self.bounds = np.array(bounds, dtype=np.float64)
        check_float32(self.bounds)
        self.lipschitz = float(lipschitz)
        self.up_axis = up_axis
        self.label_names = checked_strings(label_names, "label_names")
        self.device = checked_device(device)

    def phi(self, points: Any) -> Any:
        """The signed function [m], negative inside.

        Args:
            points: Positions [m]: an array [n, 3], or a Warp array of vec3.

        Returns:
            float32 [n]: a NumPy array for NumPy points, a Warp array on the same device for Warp points.

        Raises:
            InputError: NumPy points have another shape, or are not finite.
        """
        if isinstance(points, wp.array):
            return self._phi(_checked_vec3(points))
        return self._phi(self._on_device(points)).numpy()

    def sampled(self, points: np.ndarray) -> np.ndarray:
        """The signed function [m] at points [..., 3], float64 [...]."""
        return np.asarray(self.phi(points.reshape(-1, 3)), np.float64).reshape(points.shape[:-1])

    def normals(self, points: np.ndarray, apart: np.ndarray) -> np.ndarray:
        """Unit normals at points [..., 3] from differences over lengths [...] [m], outwards, float64 [..., 3]."""
        slopes = self.sampled(points[..., None, :] + apart[..., None, None] * _AROUND) @ _AROUND
        return slopes / np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), 1e-300)

    def holds(self, points: npt.ArrayLike) -> np.ndarray:
        """Whether points [n, 3] [m] are inside, bool [n]."""
        return np.asarray(self.phi(points)) < 0.0

    def labels_at(self, points: Any, *, nearest: bool = False) -> Any:
        """The label at each point.

        Args:
            points: As for `phi`.
            nearest: Points outside the body, and in gaps between labels, take the nearest label instead of 0.

        Returns:
            int32 [n], as for `phi`: the label's place in ``label_names`` plus one; 0 outside any.
        """
        given = _checked_vec3(points) if isinstance(points, wp.array) else self._on_device(points)
        if self.label_names:
            labels = self._labels(given)
            if not nearest:
                wp.launch(kernels.clear_labels_outside, given.size, [self._phi(given)], [labels], device=given.device)
        else:
            labels = wp.zeros(given.size, wp.int32, device=given.device)
        return labels if isinstance(points, wp.array) else labels.numpy()

    @property
    def has_pieces(self) -> bool:
        """Whether the body has, or may have, several pieces, which must not be joined by the mesh."""
        return False

    def thickness(
        self, points: npt.ArrayLike, inward: npt.ArrayLike, reach: float, *, outside: bool = False
    ) -> np.ndarray:
        """The thickness of the body at points of its surface: the distance inwards until one leaves it again.

        Args:
            points: Points on or near the surface [n, 3] [m].
            inward: Unit vectors [n, 3].
            reach: The largest thickness that is measured [m].
            outside: Measure outwards instead: the widths of gaps.

        Returns:
            float64 [n] [m].
        """
        side = -1.0 if outside else 1.0
        given, directions = self._on_device(points), self._on_device(side * checked_numbers(inward, "inward", "[n, 3]"))
        if len(given) != len(directions):
            raise InputError(f"inward has {len(directions)} vectors; there must be one for each of {len(given)} points")
        return self._thickness(given, directions, checked_length(reach, "reach"), side).astype(np.float64)

    def exits(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Where segments from inside to outside leave the body, by its triangles; None if it has none.

        Args:
            starts, ends: float64 [n, 3] [m].

        Returns:
            The distances from the starts as shares of the segments, NaN if triangles cannot tell, float64 [n]; and the
            unit normals there [n, 3].
        """
        return None

    def part(self, name: str) -> Domain:
        """The domain of a single label.

        Raises:
            InputError: The domain has no label of this name; the message lists its labels.
        """
        if name in self.label_names:
            return self._part(name)
        there = ", ".join(self.label_names) or "none"
        raise InputError(f"there is no label {shown(name)} in this domain; its labels: {there}")

    def report(self) -> list[str]:
        """A summary, line by line: size, unit, openness, pieces, labels."""
        low, high = self.bounds
        size = " x ".join(length(side) for side in high - low)
        lines = [f"bounds {size}, {self.up_axis} up", *self._details()]
        if self.label_names:
            lines.append(f"labels: {', '.join(self.label_names)}")
        return lines

    def points_in(self, name: str, count: int) -> np.ndarray:
        """Up to ``count`` points with a label, the first near their middle [m], float64 [n, 3]; none if none is known
        without a search."""
        return np.empty((0, 3))

    @property
    def label_volumes(self) -> np.ndarray:
        """The volumes of the labels [m^3], float64 [labels]; NaN if they are not known without a search."""
        return np.full(len(self.label_names), np.nan)

    def named(self, name: str) -> Domain:
        """The same body, with one label of that name everywhere.

        In a union, the label of the first domain that holds a point counts: ``tumour.named("tumour") | liver``.
        """
        from .surface import NamedDomain

        return NamedDomain(self, name)

    def __or__(self, other: Domain) -> Domain:
        from .surface import UnionDomain

        return UnionDomain(self, other) if isinstance(other, Domain) else NotImplemented

    def __and__(self, other: Domain) -> Domain:
        from .surface import IntersectionDomain

        return IntersectionDomain(self, other) if isinstance(other, Domain) else NotImplemented

    def __sub__(self, other: Domain) -> Domain:
        from .surface import DifferenceDomain

        return DifferenceDomain(self, other) if isinstance(other, Domain) else NotImplemented

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

        return label_domain(volume, labels, (spacing, origin, affine, unit), smoothing, up_axis, device)

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

        return probability_domain(maps, certain, (spacing, origin, affine, unit), smoothing, up_axis, device)

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
        from .surface import FunctionDomain

        return FunctionDomain(function, bounds, lipschitz, up_axis=up_axis, device=device)

    @classmethod
    def sphere(cls, radius: float, centre: Sequence[float] = (0.0, 0.0, 0.0), **options: Any) -> Domain:
        """A ball [m]. Options here and below: ``up_axis``, ``device``."""
        from .surface import sphere

        return sphere(radius, centre, **options)

    @classmethod
    def box(cls, lower: Sequence[float], upper: Sequence[float], **options: Any) -> Domain:
        """An axis-aligned box between two corners [m]."""
        from .surface import box

        return box(lower, upper, **options)

    @classmethod
    def torus(
        cls, major: float, minor: float, centre: Sequence[float] = (0.0, 0.0, 0.0), axis: str = "Z", **options: Any
    ) -> Domain:
        """A ring: a tube of radius ``minor`` around a circle of radius ``major`` [m] about an axis."""
        from .surface import torus

        return torus(major, minor, centre, axis, **options)

    @classmethod
    def capsule(cls, start: Sequence[float], end: Sequence[float], radius: float, **options: Any) -> Domain:
        """All points within ``radius`` of the segment between two points [m]."""
        from .surface import capsule

        return capsule(start, end, radius, **options)

    # Methods that each kind of body defines.

    def _phi(self, points: wp.array) -> wp.array:
        """The function at points: float32 [n] on the points' device [m]."""
        raise NotImplementedError

    def _labels(self, points: wp.array) -> wp.array:
        """Labels int32 [n] on the points' device; outside the body the labels of the nearest part."""
        raise NotImplementedError

    def _thickness(self, points: wp.array, along: wp.array, reach: float, side: float) -> np.ndarray:
        """The thickness of the body for a ``side`` of 1, of the space around it for -1: float32 [n] [m].

        By sphere tracing: each step is the distance within which there can be no surface.
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

    def _part(self, name: str) -> Domain:
        """The domain of one of its labels."""
        raise NotImplementedError

    def _details(self) -> list[str]:
        return []

    def _on_device(self, points: npt.ArrayLike) -> wp.array:
        given = np.ascontiguousarray(checked_points(points), dtype=np.float32)
        return wp.array(given, dtype=wp.vec3, device=self.device)


def _checked_vec3(points: wp.array) -> wp.array:
    if points.dtype != wp.vec3 or points.ndim != 1:
        found = f"{wp.types.type_repr(points.dtype)} {list(points.shape)}"
        raise InputError(f"points is a Warp array of {found}; it must be of vec3 [n]")
    return points
