"""Pictures of surfaces on the CPU: the nearest triangle at each pixel, and its shaded colour."""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Pixels without a triangle.
NOTHING = wp.constant(wp.int64(-1))
#: The cosine between normals of triangles that face alike.
ALIKE = wp.constant(0.98)


@wp.func
def twice_area(a: wp.vec3, b: wp.vec3, x: float, y: float):
    """Twice the area of a triangle, positive if it runs counter-clockwise."""
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


@wp.func
def shares_at(a: wp.vec3, b: wp.vec3, c: wp.vec3, x: float, y: float):
    """Barycentric coordinates of a pixel."""
    return wp.vec3(twice_area(b, c, x, y), twice_area(c, a, x, y), twice_area(a, b, x, y)) / twice_area(
        a, b, c[0], c[1]
    )


@wp.kernel(enable_backward=False)
def find_nearest(
    # In
    corners: wp.array2d[wp.vec3],
    # In and out
    nearest: wp.array2d[wp.int64],
):
    """Find the triangle that is nearest to the viewer at the middle of each pixel.

    Args:
        corners: Pixels to the right and down, and the inverse distance to the viewer over the largest one, which is
            linear along lines of the picture, [F, 3].
        nearest: That inverse distance in the upper half of the bits, and the triangle in the lower.
    """
    f = wp.tid()
    a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
    if twice_area(a, b, c[0], c[1]) == 0.0:
        return
    low, high = wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c)
    left, top = wp.max(int(wp.ceil(low[0] - 0.5)), 0), wp.max(int(wp.ceil(low[1] - 0.5)), 0)
    right = wp.min(int(wp.floor(high[0] - 0.5)), nearest.shape[1] - 1)
    bottom = wp.min(int(wp.floor(high[1] - 0.5)), nearest.shape[0] - 1)
    first = shares_at(a, b, c, float(left) + 0.5, float(top) + 0.5)
    across = shares_at(a, b, c, float(left) + 1.5, float(top) + 0.5) - first
    down = shares_at(a, b, c, float(left) + 0.5, float(top) + 1.5) - first
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            shares = first + float(column - left) * across + float(row - top) * down
            if wp.min(shares) >= -1.0e-5:
                near = wp.int64(1.0e9 * wp.dot(shares, wp.vec3(a[2], b[2], c[2])))
                wp.atomic_max(nearest, row, column, (near << wp.int64(32)) | wp.int64(f))


@wp.struct
class Lit:
    """What the colours of triangles come from.

    Attributes:
        corners: As for `find_nearest`, [F, 3].
        points, normals: At the corners of triangles [F, 3].
        values: Places in the table of colours from 0 to 1 [F, 3]; NaN for what is ``rigid``.
        table: Linear colours.
        viewer: Where the viewer is [m].
        up, key, fill: Unit vectors up and to the lights.
        edge: Half of the width of the lines along edges [pixels]; 0 for none.
        encoded: sRGB of evenly spaced linear values.
    """

    corners: wp.array2d[wp.vec3]
    points: wp.array2d[wp.vec3]
    normals: wp.array2d[wp.vec3]
    values: wp.array2d[float]
    table: wp.array[wp.vec3]
    rigid: wp.vec3
    viewer: wp.vec3
    up: wp.vec3
    key: wp.vec3
    fill: wp.vec3
    edge: float
    encoded: wp.array[wp.uint8]


@wp.func
def color_at(lit: Lit, f: int, x: float, y: float):
    """The colour of a triangle at a place of the picture, sRGB from 0 to 255."""
    a, b, c = lit.corners[f, 0], lit.corners[f, 1], lit.corners[f, 2]
    flat = shares_at(a, b, c, x, y)
    shares = wp.cw_mul(flat, wp.vec3(a[2], b[2], c[2]))
    shares /= shares[0] + shares[1] + shares[2]
    normal, point, value = wp.vec3(0.0), wp.vec3(0.0), float(0.0)
    for k in range(3):
        normal += shares[k] * lit.normals[f, k]
        point += shares[k] * lit.points[f, k]
        value += shares[k] * lit.values[f, k]
    normal = wp.normalize(normal)
    base = lit.rigid
    if not wp.isnan(value):
        base = lit.table[int(wp.clamp(value, 0.0, 1.0) * float(lit.table.shape[0] - 1) + 0.5)]
    lambert = wp.max((wp.dot(normal, lit.key) + 0.2) / 1.2, 0.0)
    sky = 0.5 + 0.5 * wp.dot(normal, lit.up)
    # Ambient light is slightly rose: grey light would turn the colour map's yellows olive.
    ambient = 0.13 + 0.24 * sky + 0.30 * wp.max(wp.dot(normal, lit.fill), 0.0)
    light = wp.vec3(1.06 * ambient, 0.96 * ambient, ambient) + wp.vec3(0.74 * lambert)
    mirrored = wp.max(wp.dot(normal, wp.normalize(lit.key + wp.normalize(lit.viewer - point))), 0.0)
    eighth = mirrored * mirrored * mirrored * mirrored * mirrored * mirrored * mirrored * mirrored
    gloss = 0.06 * eighth * eighth * eighth
    if lit.edge > 0.0:
        # The double area of a triangle with a corner here, over its base, is the distance to that edge.
        sides = wp.vec3(wp.length(c - b), wp.length(a - c), wp.length(b - a))
        away = wp.cw_div(wp.abs(twice_area(a, b, c[0], c[1])) * flat, sides)
        if wp.min(away) < lit.edge:
            light *= 0.6
    color = wp.vec3()
    for k in range(3):
        linear = wp.clamp(base[k] * light[k] + gloss, 0.0, 1.0)
        color[k] = float(lit.encoded[int(linear * float(lit.encoded.shape[0] - 1) + 0.5)])
    return color


@wp.func
def triangle_at(nearest: wp.array2d[wp.int64], row: int, column: int):
    """The nearest triangle at a pixel, -1 if there is none."""
    return wp.where(nearest[row, column] == NOTHING, -1, int(nearest[row, column] & wp.int64(0xFFFFFFFF)))


@wp.kernel(enable_backward=False)
def shade(
    # In
    nearest: wp.array2d[wp.int64],
    lit: Lit,
    behind: wp.array2d[wp.uint8],
    palette: wp.array2d[wp.uint8],
    # Out
    image: wp.array3d[wp.uint8],
):
    """Shade the nearest triangles under a key light, a fill light and the sky; a thread has four pixels, whose colour
    is found once where they are of triangles that face alike.

    Args:
        behind: The row of the palette plus one for what is seen beside triangles; 0 for pixels that stay.
        palette: sRGB [n, 3].
        image: sRGB, [height, width, 3].
    """
    top, left = wp.tid()
    top, left = 2 * top, 2 * left
    bottom, right = wp.min(top + 2, nearest.shape[0]), wp.min(left + 2, nearest.shape[1])
    first = triangle_at(nearest, top, left)
    alike = first >= 0 and lit.edge == 0.0
    for row in range(top, bottom):
        for column in range(left, right):
            f = triangle_at(nearest, row, column)
            if alike and f != first:
                alike = f >= 0 and wp.dot(lit.normals[f, 0], lit.normals[first, 0]) > ALIKE
    color = wp.vec3()
    if alike:
        color = color_at(lit, first, float(left) + 1.0, float(top) + 1.0)
    for row in range(top, bottom):
        for column in range(left, right):
            f = triangle_at(nearest, row, column)
            if f < 0:
                if behind[row, column] > wp.uint8(0):
                    for k in range(3):
                        image[row, column, k] = palette[int(behind[row, column]) - 1, k]
            else:
                if not alike:
                    color = color_at(lit, f, float(column) + 0.5, float(row) + 0.5)
                for k in range(3):
                    image[row, column, k] = wp.uint8(color[k])
