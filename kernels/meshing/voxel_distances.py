"""Nearest voxels of a set, exact, along one axis after the other (Felzenszwalb and Huttenlocher 2012, *Distance
transforms of sampled functions*): parabolas over the voxels of a line, of which the lowest counts at each voxel.

A thread has one line of voxels; ``first`` is the number of the first thread's line.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: The squared distance where there is no voxel of the set.
NOTHING = wp.constant(1.0e30)


@wp.kernel(enable_backward=False)
def find_nearest_in_rows(
    # In
    inside: wp.array3d[wp.uint8],
    wanted: int,
    step: float,
    first: int,
    # Out
    nearest: wp.array3d[wp.int16],
    squares: wp.array3d[wp.float32],
):
    """The nearest voxel of the set on each line along the third axis, -1 for none, and the squared distance to it."""
    t = first + wp.tid()
    i = t // inside.shape[1]
    j = t % inside.shape[1]
    n = inside.shape[2]
    last = int(-1)
    for k in range(n):
        if int(inside[i, j, k]) == wanted:
            last = k
        nearest[i, j, k] = wp.int16(last)
    last = int(-1)
    for m in range(n):
        k = n - 1 - m
        if int(inside[i, j, k]) == wanted:
            last = k
        before = int(nearest[i, j, k])
        if last >= 0 and (before < 0 or last - k < k - before):
            before = last
            nearest[i, j, k] = wp.int16(last)
        away = step * float(k - before)
        squares[i, j, k] = wp.where(before < 0, NOTHING, away * away)


@wp.func
def hides(low: wp.vec2d, middle: wp.vec2d, high: wp.vec2d):
    """Whether two parabolas are below the one between them everywhere.

    Each is given by its place and by its lowest value plus the square of its place.
    """
    left = (middle[1] - low[1]) * (high[0] - middle[0])
    return left >= (high[1] - middle[1]) * (middle[0] - low[0])


@wp.func
def parabola(squares: wp.array3d[wp.float32], i: int, j: int, k: int, step: wp.float64):
    x = step * wp.float64(j)
    return wp.vec2d(x, wp.float64(squares[i, j, k]) + x * x)


@wp.kernel(enable_backward=False)
def find_nearest_across(
    # In
    squares: wp.array3d[wp.float32],
    step: wp.float64,
    first: int,
    # Scratch
    kept: wp.array3d[wp.int16],
    # Out
    nearest: wp.array3d[wp.int16],
    total: wp.array3d[wp.float32],
):
    """The voxel on each line along the second axis with the least sum of its square and its squared distance, -1 for
    none, and that sum."""
    t = first + wp.tid()
    i = t // squares.shape[2]
    k = t % squares.shape[2]
    n = squares.shape[1]
    count = int(0)
    top = wp.vec2d()
    below = wp.vec2d()
    for j in range(n):
        square = squares[i, j, k]
        counts = square < NOTHING
        if square == 0.0 and j > 0 and j < n - 1:
            # Between two voxels of the set, this one is the nearest only to itself.
            counts = squares[i, j - 1, k] > 0.0 or squares[i, j + 1, k] > 0.0
        if counts:
            x = step * wp.float64(j)
            new = wp.vec2d(x, wp.float64(square) + x * x)
            hidden = bool(count >= 2)
            while hidden:
                hidden = hides(below, top, new)
                if hidden:
                    count -= 1
                    top = below
                    hidden = count >= 2
                    if hidden:
                        below = parabola(squares, i, int(kept[i, count - 2, k]), k, step)
            kept[i, count, k] = wp.int16(j)
            count += 1
            below = top
            top = new
    at = int(0)
    here = wp.vec2d()
    after = wp.vec2d()
    if count > 0:
        here = parabola(squares, i, int(kept[i, 0, k]), k, step)
    if count > 1:
        after = parabola(squares, i, int(kept[i, 1, k]), k, step)
    for j in range(n):
        if count == 0:
            nearest[i, j, k] = wp.int16(-1)
            total[i, j, k] = NOTHING
        elif squares[i, j, k] == 0.0:
            nearest[i, j, k] = wp.int16(j)
            total[i, j, k] = 0.0
        else:
            x = step * wp.float64(j)
            best = here[1] - wp.float64(2.0) * x * here[0]
            going = bool(at + 1 < count)
            while going:
                value = after[1] - wp.float64(2.0) * x * after[0]
                going = value <= best
                if going:
                    best = value
                    at += 1
                    here = after
                    going = at + 1 < count
                    if going:
                        after = parabola(squares, i, int(kept[i, at + 1, k]), k, step)
            nearest[i, j, k] = kept[i, at, k]
            total[i, j, k] = float(best + x * x)


@wp.kernel(enable_backward=False)
def take_distances(
    # In
    inside: wp.array3d[wp.uint8],
    wanted: int,
    along_first: wp.array3d[wp.int16],
    along_second: wp.array3d[wp.int16],
    along_third: wp.array3d[wp.int16],
    spacing: wp.vec3,
    first: int,
    # Out
    phi: wp.array3d[wp.float32],
    nearest: wp.array4d[wp.int16],
):
    """Distances from voxels outside the set to the nearest voxel of the set, less half of the last step.

    If the set is the body's inside, distances are positive, and the nearest voxels are written, too.
    """
    t = first + wp.tid()
    i = t // inside.shape[1]
    j = t % inside.shape[1]
    for k in range(inside.shape[2]):
        own = int(inside[i, j, k])
        if own != wanted:
            x = int(along_first[i, j, k])
            y = int(along_second[x, j, k])
            z = int(along_third[x, y, k])
            steps = wp.max(wp.max(wp.abs(x - i), wp.abs(y - j)), wp.abs(z - k))
            apart = wp.cw_mul(spacing, wp.vec3(float(x - i), float(y - j), float(z - k)))
            away = wp.length(apart) * (1.0 - 0.5 / float(steps))
            phi[i, j, k] = wp.where(wanted == 1, away, -away)
            if wanted == 1:
                nearest[0, i, j, k] = wp.int16(x)
                nearest[1, i, j, k] = wp.int16(y)
                nearest[2, i, j, k] = wp.int16(z)
        elif wanted == 1:
            nearest[0, i, j, k] = wp.int16(i)
            nearest[1, i, j, k] = wp.int16(j)
            nearest[2, i, j, k] = wp.int16(k)
