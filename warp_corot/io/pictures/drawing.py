"""Shaded surfaces drawn into Matplotlib axes.

A surface is drawn as triangles, back to front (painter's algorithm): faces that face away are left out, the others are
cut into pieces small enough for smooth shading, whose corners are shaded and colours between them interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warp_corot.errors import InputError

from .colors import STEEL, TISSUE, color_index, round_limit, srgb_to_linear, stress_colors

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# --- the camera ------------------------------------------------------------------------------------------------------

Array = NDArray[np.float64]


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
        right, up, front = _world_axes(up_axis)
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

    def rays(self, points: Array) -> Array:
        """Unit vectors from points [..., 3] to the viewer."""
        towards = self.center + self.distance * self.axes[2] - points
        return towards / np.linalg.norm(towards, axis=-1, keepdims=True)

    def sees_outside(self, points: Array, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which triangles [n, 3] of points [N, 3] show their outer side."""
        u, v = self.project(points)[0].T
        a, b, c = faces.T
        return (u[b] - u[a]) * (v[c] - v[a]) > (v[b] - v[a]) * (u[c] - u[a])


def _world_axes(up_axis: str) -> tuple[Array, Array, Array]:
    """Right, up and front (towards a viewer at azimuth 0), a right-handed triple."""
    if up_axis not in ("X", "Y", "Z"):
        raise InputError(f"up_axis is {up_axis!r}; it must be X, Y or Z")
    x, y, z = np.eye(3)
    return {"Y": (x, y, z), "Z": (x, z, -y), "X": (z, x, y)}[up_axis]


# --- soft shadows on the ground --------------------------------------------------------------------------------------


def draw_shadow(ax: Axes, triangles: Array, camera: Camera, height: float, cells: int = 120) -> Array:
    """Draw a soft shadow on the ground: the body's points projected along the light, counted in cells and blurred.

    Returns the picture coordinates [n, 2] of the cells that are visibly dark.
    """
    from matplotlib.collections import QuadMesh
    from scipy.ndimage import gaussian_filter

    up = camera.world_up
    right = camera.axes[0]
    back = np.cross(up, right)  # with ``right`` it spans the ground
    bary = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), size=max(1, 40_000 // len(triangles)))
    points = np.einsum("sb,fbx->fsx", bary, triangles).reshape(-1, 3)
    dropped = dropped_shadow(points, camera, height)
    flat = np.stack([dropped @ right, dropped @ back], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    margin = 0.22 * float((high - low).max()) + 1e-12
    low, high = low - margin, high + margin
    dark = np.zeros((cells, cells))
    dark[tuple(np.minimum((flat - low) / (high - low) * cells, cells - 1).astype(int).T)] = 1.0
    # Two widths: a tight contact shadow within a wide soft one.
    dark = 0.5 * gaussian_filter(dark, 0.012 * cells) + 0.5 * gaussian_filter(dark, 0.05 * cells)
    middles = low + (np.arange(cells)[:, None] + 0.5) / cells * (high - low)
    u, v = np.meshgrid(*middles.T, indexing="ij")
    ground = u[..., None] * right + v[..., None] * back + height * up
    picture, _ = camera.project(ground)
    # Opaque on white: transparent cells that overlap by part of a pixel would show their seams.
    tint = 1.0 - 0.26 * dark[..., None] * (1.0 - np.array([0.20, 0.20, 0.27]))
    mesh = QuadMesh(picture, facecolor=tint[:-1, :-1].reshape(-1, 3), antialiased=False, zorder=0)
    ax.add_collection(mesh, autolim=False)
    return picture[dark > 0.2]


def dropped_shadow(points: Array, camera: Camera, height: float) -> Array:
    """Projections of points [n, 3] along the light onto the ground [n, 3]."""
    up, right = camera.world_up, camera.axes[0]
    light = -0.30 * right + 1.0 * up - 0.12 * np.cross(up, right)
    lift = np.maximum(points @ up - height, 0.0)
    return points - lift[:, None] / (light @ up) * light


# --- the body --------------------------------------------------------------------------------------------------------

INK = "#3b3640"
_PIECES = 30_000  # approximate number of triangles of a body
_CREASE = math.cos(math.radians(40.0))  # edges sharper than this stay sharp
_DOTS_ACROSS = 160  # dots are at least the distance to the viewer over this apart
_BEFORE = 5e-3  # fraction of the body's size: a surface that much nearer than a dot hides it
_GHOST, _GHOST_LINE = (0.90, 0.91, 0.93), (0.74, 0.76, 0.80)


def draw_body(
    ax: Axes,
    positions: ArrayLike,
    faces: ArrayLike,
    *,
    scalars: ArrayLike | None = None,
    value_range: tuple[float, float] | None = None,
    rest: ArrayLike | None = None,
    camera: Camera | None = None,
    up_axis: str = "Y",
    color: tuple[float, float, float] = TISSUE,
    edges: bool = False,
    ground: float | bool = True,
    square: ArrayLike | None = None,
    held: ArrayLike | None = None,
    pieces: int = _PIECES,
) -> Camera:
    """Draw a shaded surface into Matplotlib axes.

    Args:
        ax: The axes; their frame is switched off and their limits widened to the drawing.
        positions: Nodes [N, 3] [m]. Nodes of no face do not matter.
        faces: Triangles [F, 3], wound counter-clockwise seen from outside (`boundary_faces`).
        scalars: Values to colour by, one a node [N] or one a face [F]; NaN for rigid things, which are grey.
        value_range: Values at the two ends of the colour map; None: 0 to the 99th percentile, rounded up.
        rest: Nodes at rest [N, 3] [m], drawn as a faint silhouette in the background.
        camera: The camera; None: one that sees ``positions`` and ``rest``.
        up_axis: "X", "Y" or "Z".
        color: Colour of a body without scalars, sRGB.
        edges: Whether to draw the edges of the faces.
        ground: Height [m] of a ground that shows the shadow; True: below the lowest node; False: none.
        square: Corners of a ground that is outlined [4, 3] [m].
        held: Nodes marked with dots, mask [N].
        pieces: Approximate number of triangles into which the surface is cut.

    Returns:
        The camera used, for the next body.

    Raises:
        InputError: Arrays that do not fit each other, or positions that are not finite.
    """
    from .artists import Triangles

    x, tri = checked_surface(positions, faces, "positions")
    x_rest = None if rest is None else checked_surface(rest, faces, "rest")[0]
    used = np.unique(tri)
    seen = np.concatenate([each[used] for each in (x, x_rest) if each is not None])
    if camera is None:
        camera = Camera.fit(seen, up_axis)
    if ground is not False:
        height = float((seen @ camera.world_up).min()) if ground is True else float(ground)
        shadow = draw_shadow(ax, x[tri], camera, height)
        ax.update_datalim(shadow)
    if square is not None:
        outline = camera.project(np.asarray(square, dtype=np.float64))[0]
        _fill(ax, outline[None], "none", _GHOST_LINE, width=1.0, order=1)
        ax.update_datalim(outline)
    if x_rest is not None:
        draw_silhouette(ax, x_rest, tri, camera)

    values = _values(scalars, len(x), tri)
    front = camera.sees_outside(x, tri)
    faces_seen = tri[front]
    normals = _corner_normals(x, tri, front)
    lowest, highest = value_range or value_limits(scalars)
    cut, normals, values = _cut(x[faces_seen], normals, None if values is None else values[front], pieces)
    _draw_outline(ax, x, faces_seen, INK, camera, width=1.6, order=3)
    flat, depth = camera.project(cut)
    order = np.argsort(depth.sum(axis=1))
    if values is None:
        base = np.broadcast_to(srgb_to_linear(color), normals.shape)
    else:
        base = srgb_to_linear(stress_colors())[color_index(values, lowest, highest)]
        base = np.where(np.isnan(values)[..., None], srgb_to_linear(STEEL), base)
    shaded = _shade(base, normals, camera.rays(cut), camera)
    ax.add_artist(Triangles(flat[order], shaded[order], order=4))
    if edges:
        drawn = camera.project(x)[0][faces_seen]
        _fill(ax, drawn, "none", (0.23, 0.21, 0.25, 0.25), width=0.4, order=5)
    if held is not None and np.any(held):
        _draw_dots(ax, x, faces_seen, np.asarray(held, dtype=bool), camera)
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.update_datalim(camera.project(seen)[0])
    ax.margins(0.06)
    ax.autoscale_view()
    return camera


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


def _values(scalars: ArrayLike | None, nodes: int, tri: NDArray[np.int64]) -> Array | None:
    """Values at the corners of the faces [F, 3]."""
    if scalars is None:
        return None
    values = np.asarray(scalars, dtype=np.float64)
    if values.shape == (nodes,):
        return values[tri]
    if values.shape == (len(tri),):
        return np.repeat(values[:, None], 3, axis=1)
    raise InputError(f"scalars has shape {list(values.shape)}; it must be [{nodes}] (nodes) or [{len(tri)}] (faces)")


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


def _cut(x: Array, normals: Array, values: Array | None, count: int) -> tuple[Array, Array, Array | None]:
    """Cut triangles [F, 3, 3] into n² each: corners and their normals [m, 3, 3], and their values [m, 3]."""
    n = int(np.clip(math.sqrt(count / max(len(x), 1)), 1, 24))
    if n == 1:
        return x, normals, values
    weights = []
    for i in range(n):
        for j in range(n - i):
            a, b, c = (i, j), (i + 1, j), (i, j + 1)
            weights.append((a, b, c))
            if i + j < n - 1:
                weights.append((b, (i + 1, j + 1), c))
    uv = np.array(weights, dtype=np.float64) / n
    bary = np.stack([1.0 - uv.sum(axis=2), uv[..., 0], uv[..., 1]], axis=2)  # [n², corner, 3]
    pieces, turned = (np.einsum("scb,fbx->fscx", bary, each).reshape(-1, 3, 3) for each in (x, normals))
    turned /= np.maximum(np.linalg.norm(turned, axis=2, keepdims=True), 1e-300)
    return pieces, turned, None if values is None else np.einsum("scb,fb->fsc", bary, values).reshape(-1, 3)


def _shade(base: Array, normals: Array, rays: Array, camera: Camera) -> Array:
    """sRGB colours of linear base colours under a key light from the upper left, a fill light and the sky."""
    right, _, front = camera.axes
    key = _unit(-0.45 * right + 0.80 * camera.world_up + 0.60 * front)
    fill = _unit(0.9 * right + 0.1 * camera.world_up + 0.5 * front)
    lambert = np.clip((normals @ key + 0.2) / 1.2, 0.0, None)
    sky = 0.5 + 0.5 * normals @ camera.world_up
    # Ambient light is slightly rose: grey light would turn the colour map's yellows olive.
    ambient = (0.13 + 0.24 * sky + 0.30 * np.clip(normals @ fill, 0.0, None))[..., None] * np.array([1.06, 0.96, 1.0])
    light = ambient + 0.74 * lambert[..., None]
    halfway = key + rays
    halfway /= np.linalg.norm(halfway, axis=-1, keepdims=True)
    gloss = 0.06 * np.clip((normals * halfway).sum(axis=-1), 0.0, None) ** 24
    linear = np.clip(base * light + gloss[..., None], 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def draw_silhouette(ax: Axes, x: Array, tri: NDArray[np.int64], camera: Camera) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    front = tri[camera.sees_outside(x, tri)]
    _draw_outline(ax, x, front, _GHOST_LINE, camera, width=2.2, order=1)
    # One path of triangles that turn the same way is filled as a whole, without seams.
    flat, _ = camera.project(x[front])
    closed = np.concatenate([flat, flat[:, :1]], axis=1)
    codes = np.tile([Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY], len(flat)).astype(Path.code_type)
    filled = Path(closed.reshape(-1, 2), codes)
    ax.add_artist(PathPatch(filled, facecolor=_GHOST, edgecolor=_GHOST, linewidth=0.3, zorder=2))


def _draw_outline(
    ax: Axes, x: Array, front: NDArray[np.int64], color: Any, camera: Camera, *, width: float, order: int
) -> None:
    """Draw lines along edges of only one of the faces that face the viewer [n, 3]; inner ones are drawn over."""
    from matplotlib.collections import LineCollection

    ends = np.sort(front[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys, count = np.unique(ends[:, 0] * len(x) + ends[:, 1], return_counts=True)
    alone = keys[count == 1]
    lines, _ = camera.project(x[np.stack([alone // len(x), alone % len(x)], axis=1)])
    drawn = LineCollection(cast(Any, lines), colors=color, linewidth=width, capstyle="round", zorder=order)
    ax.add_collection(drawn, autolim=False)


def _fill(ax: Axes, polygons: Array, face: Any, edge: Any, *, width: float, order: int) -> None:
    from matplotlib.collections import PolyCollection

    collection = PolyCollection(
        cast(Any, polygons), facecolor=face, edgecolor=edge, linewidth=width, joinstyle="round", zorder=order
    )
    ax.add_collection(collection, autolim=False)


def _draw_dots(ax: Axes, x: Array, faces: NDArray[np.int64], held: NDArray[np.bool_], camera: Camera) -> None:
    """Draw dots on held nodes of the faces that face the viewer, where nothing hides them, and far enough apart."""
    marked = np.unique(faces[held[faces]])
    if not len(marked):
        return
    flat, _ = camera.project(x[marked])
    # Cells of the picture, not of the body, so that the dots of a film do not change with the motion.
    cells = np.floor(flat / (camera.distance / _DOTS_ACROSS)).astype(int)
    _, first = np.unique(cells, axis=0, return_index=True)
    seen = first[_visible(x[marked[first]], x, faces, camera)]
    ax.plot(*flat[seen].T, ".", color=INK, markersize=4.5, markeredgewidth=0.0, zorder=6)


def _visible(points: Array, x: Array, faces: NDArray[np.int64], camera: Camera) -> NDArray[np.bool_]:
    """Which points [n, 3] are not hidden by any of the faces [F, 3] of nodes ``x``."""
    flat, depth = camera.project(points)
    node_flat, node_depth = camera.project(x)
    corners, corner_depth = node_flat[faces], node_depth[faces]
    (low_x, low_y), (high_x, high_y) = (
        end(end(corners[:, 0], corners[:, 1]), corners[:, 2]).T.copy() for end in (np.minimum, np.maximum)
    )
    size = float(np.linalg.norm(np.ptp(x[np.unique(faces)], axis=0)))
    found = np.ones(len(points), bool)
    for index, (place, own) in enumerate(zip(flat, depth, strict=True)):
        u, v = place
        near = np.flatnonzero((low_x <= u) & (u <= high_x) & (low_y <= v) & (v <= high_y))
        ends = corners[near] - place
        weights = np.stack([_cross(ends[:, (k + 1) % 3], ends[:, (k + 2) % 3]) for k in range(3)], axis=1)
        inside = (weights >= 0.0).all(axis=1) & (weights.sum(axis=1) > 0.0)
        weights = weights[inside] / weights[inside].sum(axis=1, keepdims=True)
        # Along a line of the picture, the inverse distance to the viewer is linear.
        away = 1.0 / (weights / (camera.distance - corner_depth[near][inside])).sum(axis=1)
        found[index] = not (away < camera.distance - own - _BEFORE * size).any()
    return found


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)
