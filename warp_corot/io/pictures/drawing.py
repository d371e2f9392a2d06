"""Shaded surfaces as images: triangles in a depth buffer, with a soft shadow on the ground and the shape at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from warp_corot.errors import InputError
from warp_corot.kernels.viewing import pictures as kernels

from .colors import STEEL, TISSUE, round_limit, srgb_to_linear, stress_colors

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
INK = "#3b3640"
_INK, _GHOST, _GHOST_LINE = (59, 54, 64), (230, 232, 237), (189, 194, 204)
#: sRGB of 4096 evenly spaced linear values.
_LINEAR = np.linspace(0.0, 1.0, 4096)
_ENCODED = np.where(_LINEAR <= 0.0031308, 12.92 * _LINEAR, 1.055 * _LINEAR ** (1 / 2.4) - 0.055)
_ENCODED = np.rint(255.0 * _ENCODED).astype(np.uint8)
_CREASE = math.cos(math.radians(40.0))  # edges sharper than this stay sharp
_DOTS_ACROSS = 160  # dots are at least the distance to the viewer over this apart
_BEFORE = 5e-3  # fraction of the distance to the viewer: a surface that much nearer than a dot hides it

# --- the camera ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """A mild perspective view. The viewer looks along ``-axes[2]``; picture coordinates are right and up.

    Attributes:
        center: Point in the middle of the picture [m], [3].
        axes: Rows: right, up, towards the viewer; [3, 3].
        distance: From the viewer to ``center`` [m].
        world_up: The stage's up direction, [3].
    """

    center: Array
    axes: Array
    distance: float
    world_up: Array

    @classmethod
    def fit(cls, points: ArrayLike, up_axis: str = "Y", azimuth: float = 35.0, elevation: float = 14.0) -> Camera:
        """A camera that sees all of ``points`` [n, 3] from ``azimuth`` [°] round the up axis and ``elevation`` [°].

        Azimuth 0 looks along −Z where Y is up, along +Y where Z is up, along −Y where X is up.
        """
        if up_axis not in ("X", "Y", "Z"):
            raise InputError(f"up_axis is {up_axis!r}; it must be X, Y or Z")
        i, j, k = np.eye(3)
        # To the right, up and towards a viewer at azimuth 0: a right-handed triple.
        right, up, front = {"Y": (i, j, k), "Z": (i, k, -j), "X": (k, i, j)}[up_axis]
        a, e = math.radians(azimuth), math.radians(elevation)
        towards = math.cos(e) * (math.cos(a) * front + math.sin(a) * right) + math.sin(e) * up
        across = math.cos(a) * right - math.sin(a) * front
        x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        low, high = x.min(axis=0), x.max(axis=0)
        size = float(np.linalg.norm(high - low)) or 1.0
        axes = np.stack([across, np.cross(towards, across), towards])
        return cls((low + high) / 2.0, axes, 3.5 * size, up)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Picture coordinates [..., 2] and depth [...] (larger is nearer) of points [..., 3]."""
        seen = ((points - self.center).reshape(-1, 3) @ self.axes.T).reshape(points.shape)
        depth = seen[..., 2]
        return seen[..., :2] * (self.distance / (self.distance - depth))[..., None], depth

    def sees_outside(self, points: Array, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which triangles [n, 3] of points [N, 3] show their outer side."""
        u, v = self.project(points)[0].T
        a, b, c = faces.T
        return (u[b] - u[a]) * (v[c] - v[a]) > (v[b] - v[a]) * (u[c] - u[a])


def dropped_shadow(points: Array, camera: Camera, height: float) -> Array:
    """Projections of points [n, 3] along the light onto the ground [n, 3]."""
    up, right = camera.world_up, camera.axes[0]
    light = -0.30 * right + 1.0 * up - 0.12 * np.cross(up, right)
    lift = np.maximum(points @ up - height, 0.0)
    return points - lift[:, None] / (light @ up) * light


# --- the body --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Window:
    """The part of a picture's plane that an image shows.

    Attributes:
        low, high: Lowest and highest picture coordinates, [2].
        size: Pixels to the right and down.
        fineness: Pixels in the width of a thin line.
    """

    low: Array
    high: Array
    size: tuple[int, int]
    fineness: float = 1.0

    def pixels(self, flat: Array) -> Array:
        """Pixels to the right and down, of picture coordinates [..., 2]."""
        there = (flat - self.low) / (self.high - self.low)
        return np.stack([there[..., 0], 1.0 - there[..., 1]], axis=-1) * self.size


def draw_body(
    ax: Axes,
    positions: ArrayLike,
    faces: ArrayLike,
    *,
    rest: ArrayLike | None = None,
    camera: Camera | None = None,
    up_axis: str = "Y",
    ground: float | bool = True,
    **options: Any,
) -> Camera:
    """Draw a shaded surface into Matplotlib axes, whose frame is switched off; see `render`.

    Args:
        ax: The axes; their limits become those of the drawing.
        positions, faces, rest: As for `render`.
        camera: The camera; None: one that sees ``positions`` and ``rest``.
        up_axis: "X", "Y" or "Z".
        ground: Height [m] of a ground that shows the shadow; True: below the lowest node; False: none.
        options: As for `render`.

    Returns:
        The camera used, for the next body.

    Raises:
        InputError: See `render`.
    """
    given = [positions] if rest is None else [positions, rest]
    seen = np.concatenate([x[np.unique(tri)] for x, tri in (checked_surface(x, faces, "positions") for x in given)])
    camera = camera or Camera.fit(seen, up_axis)
    height = float((seen @ camera.world_up).min()) if ground is True else None if ground is False else float(ground)
    window = framed(camera, seen, height)
    box = ax.get_window_extent()
    scale = 2.0 * min(box.width / (window.high - window.low)[0], box.height / (window.high - window.low)[1])
    size = np.maximum(scale * (window.high - window.low), 1.0).astype(int)
    window = Window(window.low, window.high, (int(size[0]), int(size[1])), 3.0)
    ghost = None if rest is None else silhouette(window, camera, rest, faces)
    image = render(window, camera, positions, faces, ghost=ghost, ground=height, **options)
    (left, bottom), (right, top) = window.low, window.high
    ax.imshow(image, extent=(left, right, bottom, top), interpolation="antialiased")
    ax.set_axis_off()
    return camera


def framed(camera: Camera, points: Array, height: float | None, margin: float = 0.06) -> Window:
    """A window of no size around points [n, 3] and their shadows on a ground, if there is one."""
    shadow = [] if height is None else [dropped_shadow(points, camera, height)]
    flat = camera.project(np.concatenate([points, *shadow]))[0]
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = margin * float((high - low).max()) + 1e-12
    return Window(low - room, high + room, (0, 0))


def render(
    window: Window,
    camera: Camera,
    positions: ArrayLike,
    faces: ArrayLike,
    *,
    scalars: ArrayLike | None = None,
    value_range: tuple[float, float] | None = None,
    ghost: NDArray[np.uint8] | None = None,
    color: tuple[float, float, float] = TISSUE,
    edges: bool = False,
    ground: float | None = None,
    square: ArrayLike | None = None,
    held: ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Draw a shaded surface on white.

    Args:
        window, camera: What is seen.
        positions: Nodes [N, 3] [m]. Nodes of no face do not matter.
        faces: Triangles [F, 3], wound counter-clockwise seen from outside (`boundary_faces`).
        scalars: Values to colour by, one a node [N] or one a face [F]; NaN for rigid things, which are grey.
        value_range: Values at the two ends of the colour map; None: 0 to the 99th percentile, rounded up.
        ghost: A faint silhouette in the background, from `silhouette`.
        color: Colour of a body without scalars, sRGB.
        edges: Whether to draw the edges of the faces.
        ground: Height [m] of a ground that shows the shadow; None: none.
        square: Corners of a ground that is outlined [4, 3] [m].
        held: Nodes marked with dots, mask [N].

    Returns:
        RGB, uint8 [height, width, 3].

    Raises:
        InputError: Arrays that do not fit each other, or positions that are not finite.
    """
    from PIL import Image, ImageDraw
    from scipy.ndimage import gaussian_filter

    x, tri = checked_surface(positions, faces, "positions")
    values, line = None, max(round(window.fineness), 1)
    if scalars is not None:  # at the corners of faces
        given = np.asarray(scalars, dtype=np.float64)
        if given.shape not in ((len(x),), (len(tri),)):
            shape, nodes, count = list(given.shape), len(x), len(tri)
            raise InputError(f"scalars has shape {shape}; it must be [{nodes}] (nodes) or [{count}] (faces)")
        values = given[tri] if len(given) == len(x) else np.repeat(given[:, None], 3, axis=1)
    image = np.full((window.size[1], window.size[0], 3), 255, np.uint8)
    if ground is not None:  # with a soft shadow, a tight one within a wide one
        dropped = dropped_shadow(x[tri].reshape(-1, 3), camera, ground).reshape(-1, 3, 3)
        across = float(np.ptp(window.pixels(camera.project(dropped)[0])[..., 0]))
        coarser = max(int(across / 120.0), 1)  # blurs are wide
        coarse = replace(window, size=(-(-window.size[0] // coarser), -(-window.size[1] // coarser)))
        small = (_nearest(coarse, camera, dropped)[0].numpy() >= 0).astype(np.float32)
        blurred = sum(0.5 * gaussian_filter(small, width * across / coarser) for width in (0.017, 0.07))
        dark = np.asarray(Image.fromarray(blurred).resize(window.size, Image.Resampling.BILINEAR))
        image -= (dark[..., None] * np.array([53, 53, 48])).astype(np.uint8)  # slightly blue
    if square is not None:
        outline = window.pixels(camera.project(np.asarray(square, dtype=np.float64))[0])
        ends = [tuple(corner) for corner in [*outline, outline[0]]]
        drawn = Image.fromarray(image)
        ImageDraw.Draw(drawn).line(ends, fill=_GHOST_LINE, width=line)
        image = np.array(drawn)
    behind = np.zeros(image.shape[:2], np.uint8) if ghost is None else ghost.copy()
    front = camera.sees_outside(x, tri)
    nearest, corners = _nearest(window, camera, x[tri[front]])
    behind[_widened(nearest.numpy() >= 0, line)] = 3
    lowest, highest = value_range or value_limits(scalars)
    shares = np.zeros(tri.shape) if values is None else (values - lowest) / max(highest - lowest, 1e-30)
    table = srgb_to_linear(np.array([color]) if values is None else stress_colors())
    right, _, towards = camera.axes
    key = -0.45 * right + 0.80 * camera.world_up + 0.60 * towards
    fill = 0.9 * right + 0.1 * camera.world_up + 0.5 * towards
    lit = kernels.Lit()
    lit.corners, lit.rigid, lit.edge = corners, wp.vec3(*srgb_to_linear(STEEL)), 0.5 * line * edges
    vectors = [x[tri[front]], _corner_normals(x, tri, front), table]
    lit.points, lit.normals, lit.table = (wp.array(each, dtype=wp.vec3, device="cpu") for each in vectors)
    lit.values = wp.array(shares[front], dtype=float, device="cpu")
    lit.viewer, lit.up = wp.vec3(*(camera.center + camera.distance * towards)), wp.vec3(*camera.world_up)
    lit.key, lit.fill = wp.normalize(wp.vec3(*key)), wp.normalize(wp.vec3(*fill))
    tables = (behind, np.array([_GHOST_LINE, _GHOST, _INK], np.uint8), _ENCODED)
    drawn_behind, palette, lit.encoded = (wp.array(each, dtype=wp.uint8, device="cpu", copy=False) for each in tables)
    shown = wp.array(image, dtype=wp.uint8, device="cpu", copy=False)
    blocks = [-(-each // 2) for each in nearest.shape]
    wp.launch(kernels.shade, blocks, [nearest, lit, drawn_behind, palette], [shown], device="cpu")
    if held is None or not np.any(held):
        return image
    drawn = Image.fromarray(image)
    for along, down in _dots(window, camera, x, tri[front], np.asarray(held, dtype=bool), nearest.numpy() >> 32):
        box = (along - 1.5 * line, down - 1.5 * line, along + 1.5 * line, down + 1.5 * line)
        ImageDraw.Draw(drawn).ellipse(box, fill=_INK)
    return np.array(drawn)


def silhouette(window: Window, camera: Camera, rest: ArrayLike, faces: ArrayLike) -> NDArray[np.uint8]:
    """The silhouette of nodes at rest [N, 3] [m], uint8 [height, width]: 2 inside, 1 on its outline, 0 elsewhere.

    Raises:
        InputError: See `render`.
    """
    x, tri = checked_surface(rest, faces, "rest")
    inside = _nearest(window, camera, x[tri[camera.sees_outside(x, tri)]])[0].numpy() >= 0
    drawn = _widened(inside, max(round(window.fineness), 1)).astype(np.uint8)
    drawn[inside] = 2
    return drawn


def _widened(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """A mask that reaches farther by a number of pixels along and across."""
    for _ in range(pixels):
        wide = mask.copy()
        for to, of in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
            wide[to] |= mask[of]
            wide[:, to] |= mask[:, of]
        mask = wide
    return mask


def value_limits(scalars: ArrayLike | None) -> tuple[float, float]:
    """The default ends of a colour map for values: 0 and the 99th percentile, rounded up to few digits."""
    finite = np.asarray(scalars, dtype=np.float64).ravel()
    finite = finite[np.isfinite(finite)]
    return 0.0, (round_limit(float(np.percentile(finite, 99.0))) if len(finite) else 0.0) or 1.0


def checked_surface(positions: ArrayLike, faces: ArrayLike, name: str) -> tuple[Array, NDArray[np.int64]]:
    """Positions as float64 [N, 3] and faces as int64 [F, 3].

    Raises:
        InputError: Other shapes, nodes out of range, or coordinates of the surface that are not finite.
    """
    x = np.asarray(positions, dtype=np.float64)
    tri = np.asarray(faces, dtype=np.int64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise InputError(f"{name} has shape {list(x.shape)}; it must be [N, 3]")
    if tri.ndim != 2 or tri.shape[1] != 3 or len(tri) == 0:
        raise InputError(f"faces has shape {list(tri.shape)}; it must be [F, 3] with at least one face")
    if tri.min() < 0 or tri.max() >= len(x):
        raise InputError(f"faces names nodes {tri.min()} to {tri.max()} but {name} has nodes 0 to {len(x) - 1}")
    if not np.isfinite(x[tri]).all():
        raise InputError(f"{name} has coordinates that are not finite; all must be finite")
    return x, tri


def _corner_normals(x: Array, tri: NDArray[np.int64], chosen: NDArray[np.bool_]) -> Array:
    """Unit normals at the corners of chosen faces [n, 3, 3]: averages over the node's faces within the crease angle."""
    corners = x[tri]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-300)
    order = np.argsort(tri.ravel(), kind="stable")
    count = np.bincount(tri.ravel(), minlength=len(x))
    first = np.cumsum(count) - count
    nodes = tri[chosen].ravel()
    own = np.repeat(unit[chosen], 3, axis=0)
    total = 1e-12 * own * np.abs(area).max()
    for neighbour in range(int(count.max())):
        there = np.flatnonzero(neighbour < count[nodes])
        face = order[first[nodes[there]] + neighbour] // 3
        near = np.einsum("ij,ij->i", unit[face], own[there]) > _CREASE
        total[there[near]] += area[face[near]]
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)).reshape(-1, 3, 3)


def _nearest(window: Window, camera: Camera, triangles: Array) -> tuple[wp.array, wp.array]:
    """The nearest of triangles [F, 3, 3] at each pixel, -1 for none, and their corners; see ``find_nearest``."""
    flat, depth = camera.project(triangles)
    nearness = camera.distance / (camera.distance - depth)
    corners = np.concatenate([window.pixels(flat), 0.5 * nearness[..., None]], axis=-1)
    found = wp.full((window.size[1], window.size[0]), -1, dtype=wp.int64, device="cpu")
    given = wp.array(corners, dtype=wp.vec3, device="cpu")
    wp.launch(kernels.find_nearest, len(triangles), [given], [found], device="cpu")
    return found, given


def _dots(
    window: Window, camera: Camera, x: Array, faces: NDArray[np.int64], held: NDArray[np.bool_], near: NDArray[np.int64]
) -> Array:
    """Pixels of dots on held nodes of the faces that face the viewer, where nothing hides them, far enough apart."""
    marked = np.unique(faces[held[faces]])
    flat, depth = camera.project(x[marked])
    # Cells of the picture, not of the body, so that the dots of a film do not change with the motion.
    cells = np.floor(flat / (camera.distance / _DOTS_ACROSS)).astype(int)
    first = np.unique(cells, axis=0, return_index=True)[1] if len(marked) else np.zeros(0, int)
    there = window.pixels(flat[first])
    column, row = np.clip(there, 0, np.array(window.size) - 1).astype(int).T
    own = 0.5e9 * camera.distance / (camera.distance - depth[first])
    return there[near[row, column] <= own * (1.0 + _BEFORE)]
