"""The stiffness of a dilatation that groups of elements share, as one row a group.

A group adds c g g^T to K, with g the derivative of the sum of lambda_e V_e theta_e with respect to its nodes'
displacements and c = w'' / sum of lambda_e V_e. The rows r = sqrt(|c|) g are found once for each linearisation, so that
a product reads ten nodes for eight elements and no element. What elements add besides is left to ``dilatation`` and,
where some of them are held from turning over, to ``add_held``.

A group of k nodes couples all of them: r r^T may be k times its own diagonal blocks. It is at most 4 times these with
weights w_n = sum of |r_m| / (4 |r_n|), since (sum of r_n . p_n)^2 <= sum of |r_m| times sum of (r_n . p_n)^2 / |r_n|.
The smoothers of ``implicit.multigrid`` take these weights.
"""

import warp as wp

from warp_corot.kernels.modules import Family

from .constitutive import IsotropicMaterial
from .dilatation import Dilatation, is_live, mean_of, place_of, range_of, scatter
from .elements import nodal_forces, rest_volume
from .forces import in_local_frame, own_gradient
from .simd8 import LAW_HEADERS

wp.set_module_options({"enable_backward": False})

OF_GROUPS = Family(__name__, LAW_HEADERS)

#: Threads that share a group on CUDA.
THREADS = 8
#: Lambda over mu that is no limit.
NO_LIMIT = 1.0e30


@wp.struct
class GroupNodes:
    """Groups, their elements and their nodes.

    ``corners`` has for each member where its four nodes are among the group's, eight bits each.
    """

    ranges: wp.array[wp.vec2i]  # [groups] where a group's members begin and end
    members: wp.array[wp.int32]  # elements, group after group
    corners: wp.array[wp.int32]  # [members]
    ends: wp.array[wp.int32]  # [groups] where a group's nodes end
    nodes: wp.array[wp.int32]  # [entries]


@wp.struct
class GroupRows:
    """The rows of groups."""

    rows: wp.array[wp.vec4]  # [entries] r [sqrt(N/m)], with w - 1 in the fourth lane for matrices
    factors: wp.array[wp.vec2]  # [groups] the sign of c, and whether an element is held: zero or more


# --- the groups -------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def list_members(
    # In
    starts: wp.array[wp.int32],
    given: wp.array[wp.int32],
    live: wp.array[wp.int32],
    first_group: int,
    first_place: int,
    below: int,
    # Out
    ranges: wp.array[wp.vec2i],
    members: wp.array[wp.int32],
):
    """Write the range and the members of each group, a thread for each; see ``dilatation.range_of``. Groups of
    elements from ``below`` on are left empty."""
    g = wp.tid()
    ranges[first_group + g] = wp.vec2i(0, 0)
    if not is_live(live, g):
        return
    begin, end = range_of(starts, given, g)
    if place_of(given, begin) >= below:
        return
    place = first_place + 8 * g
    if given.shape[0] > 0:
        place = first_place + begin
    for i in range(begin, end):
        members[place + i - begin] = place_of(given, i)
    ranges[first_group + g] = wp.vec2i(place, place + end - begin)


@wp.kernel(enable_backward=False)
def count_nodes(
    # In
    ranges: wp.array[wp.vec2i],
    members: wp.array[wp.int32],
    nodes: wp.array[wp.vec4i],
    # Out
    counts: wp.array[wp.int32],
):
    """The number of nodes of each group."""
    g = wp.tid()
    begin = ranges[g][0]
    count = int(0)
    for i in range(begin, ranges[g][1]):
        own = nodes[members[i]]
        for n in range(4):
            is_new = int(1)
            for j in range(begin, i):
                other = nodes[members[j]]
                if other[0] == own[n] or other[1] == own[n] or other[2] == own[n] or other[3] == own[n]:
                    is_new = 0
            count += is_new
    counts[g] = count


@wp.func
def first_entry(ends: wp.array[wp.int32], g: int):
    begin = int(0)
    if g > 0:
        begin = ends[g - 1]
    return begin


@wp.kernel(enable_backward=False)
def name_nodes(
    # In
    element_nodes: wp.array[wp.vec4i],
    # In and out
    groups: GroupNodes,
):
    """The nodes of a group, in the order in which its elements name them."""
    g = wp.tid()
    first = first_entry(groups.ends, g)
    count = int(0)
    for i in range(groups.ranges[g][0], groups.ranges[g][1]):
        own = element_nodes[groups.members[i]]
        packed = int(0)
        for n in range(4):
            corner = int(0)
            while corner < count and groups.nodes[first + corner] != own[n]:
                corner += 1
            if corner == count:
                groups.nodes[first + corner] = own[n]
                count += 1
            packed = packed | (corner << (8 * n))
        groups.corners[i] = packed


# --- the rows ---------------------------------------------------------------------------------------------------------


@wp.func
def row_at(rows: wp.array[wp.vec4], place: int):
    row = rows[place]
    return wp.vec3(row[0], row[1], row[2])


@wp.func
def add_row(rows: wp.array[wp.vec4], place: int, row: wp.vec3):
    rows[place] = rows[place] + wp.vec4(row[0], row[1], row[2], 0.0)


@wp.func
def kept_share(lam: float, mu: float, most: float):
    """The share of a group's lambda that is left if it is ``most`` mu at most."""
    share = float(1.0)
    if lam > most * mu:
        share = most * mu / lam
    return share


@OF_GROUPS.member
def write_rows(Elements: type, of: Dilatation) -> wp.Kernel:
    """Write the rows of groups from ``begin`` on at displacements u; a thread a group of each world.

    A product's groups are those of all worlds as one, of all lambda. It also needs ``factors``, and the elements'
    (lambda_e h'', w', 0, 0) in ``shared``: the first for ``add_held``, the second for ``dilatation.own_differential``.
    A matrix has no ``shared``: then rows with c < 0 are zero, and lambda counts as ``most`` mu at most.
    """
    measure, slope_of, curvature_of, holding = of.measure, of.slope, of.curvature, of.holding

    @OF_GROUPS.kernel()
    def write_rows(
        # In
        begin: int,
        world_elements: int,
        entries: int,
        groups: GroupNodes,
        elements: Elements,
        u: wp.array[wp.vec4],
        material: IsotropicMaterial,
        most: float,
        # Out
        found: GroupRows,
        shared: wp.array[wp.vec4],
    ):
        world, g = wp.tid()
        g += begin
        first = world * entries + first_entry(groups.ends, g)
        end = world * entries + groups.ends[g]
        for k in range(first, end):
            found.rows[k] = wp.vec4()
        sum = float(0.0)
        total = float(0.0)
        shear = float(0.0)
        held = float(0.0)
        for i in range(groups.ranges[g][0], groups.ranges[g][1]):
            t = world * world_elements + groups.members[i]
            theta, slope = measure(own_gradient(elements, t, u))
            lam = material.lam[t * material.stride]
            volume = rest_volume(elements, t)
            sum += lam * volume * theta
            total += lam * volume
            shear += material.mu[t * material.stride] * volume
            if shared.shape[0] > 0:
                change = holding(theta)[2]
                held = wp.max(held, change)
                shared[t] = wp.vec4(lam * change, 0.0, 0.0, 0.0)
            # Forces are minus the derivative of the energy, and this is that of the sum.
            f0, f1, f2, f3 = nodal_forces(elements, t, in_local_frame(elements, t, -lam * slope))
            corners = groups.corners[i]
            add_row(found.rows, first + (corners & 255), f0)
            add_row(found.rows, first + ((corners >> 8) & 255), f1)
            add_row(found.rows, first + ((corners >> 16) & 255), f2)
            add_row(found.rows, first + ((corners >> 24) & 255), f3)
        theta = mean_of(sum, total)
        c = mean_of(curvature_of(theta), total)
        if shared.shape[0] > 0:
            found.factors[g] = wp.vec2(wp.sign(c), held)
            for i in range(groups.ranges[g][0], groups.ranges[g][1]):
                t = groups.members[i]
                shared[t] = wp.vec4(shared[t][0], slope_of(theta), 0.0, 0.0)
        else:
            c = wp.where(total > 0.0, kept_share(total, shear, most) * wp.max(c, 0.0), 0.0)
        factor = wp.sqrt(wp.abs(c))
        size = float(0.0)
        for k in range(first, end):
            size += factor * wp.length(row_at(found.rows, k))
        for k in range(first, end):
            row = factor * row_at(found.rows, k)
            own = wp.length(row)
            weight = float(1.0)
            if own > 0.0 and shared.shape[0] == 0:
                weight = 0.25 * size / own
            found.rows[k] = wp.vec4(row[0], row[1], row[2], weight - 1.0)

    return write_rows


# --- products ---------------------------------------------------------------------------------------------------------


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float part = 0.0f;
    for (int k = begin + lane; k < end; k += lanes) {
        const float4 v = *reinterpret_cast<const float4*>(&wp::index(p, wp::index(nodes, k)));
        const float4 g = *reinterpret_cast<const float4*>(&wp::index(rows, k));
        part += g.x * v.x + g.y * v.y + g.z * v.z;
    }
    const unsigned int together = ((1u << lanes) - 1u) << (threadIdx.x & 31 & ~(lanes - 1));
    for (int step = lanes / 2; step > 0; step /= 2) part += __shfl_xor_sync(together, part, step);
    part *= factor;
    for (int k = begin + lane; k < end; k += lanes) {
        const float4 g = *reinterpret_cast<const float4*>(&wp::index(rows, k));
        const wp::vec_t<3, wp::float32> force(part * g.x, part * g.y, part * g.z);
        float* to = &wp::index(y, wp::index(nodes, k))[0];
        for (int a = 0; a < 3; ++a) atomicAdd(to + a, force[a]);
    }
#else
    #pragma clang fp contract(fast)
    typedef float float4 __attribute__((vector_size(16), aligned(4)));
    const int* node = nodes.data;
    const float4* g = reinterpret_cast<const float4*>(rows.data);
    const float4* from = reinterpret_cast<const float4*>(p.data);
    float4* to = reinterpret_cast<float4*>(y.data);
    float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
    for (int k = begin; k < end; ++k) sum += g[k] * from[node[k]];
    const float change = factor * (sum[0] + sum[1] + sum[2]);
    for (int k = begin; k < end; ++k) to[node[k]] += change * g[k];
#endif
""")
def add_group(
    lane: int,
    lanes: int,
    begin: int,
    end: int,
    factor: float,
    nodes: wp.array[wp.int32],
    rows: wp.array[wp.vec4],
    p: wp.array[wp.vec4],
    y: wp.array[wp.vec4],
):
    """y += factor g (g . p) of the entries of a group, which ``lanes`` neighbouring threads share on CUDA."""
    ...


@wp.kernel(enable_backward=False)
def add_row_products(
    # In
    lanes: int,
    groups: GroupNodes,
    found: GroupRows,
    p: wp.array[wp.vec4],
    # In and out
    y: wp.array[wp.vec4],
):
    """y += c g (g . p), which is the sign of c times r (r . p)."""
    thread = wp.tid()
    g = thread / lanes
    begin = first_entry(groups.ends, g)
    add_group(thread % lanes, lanes, begin, groups.ends[g], found.factors[g][0], groups.nodes, found.rows, p, y)


@OF_GROUPS.member
def add_held(Elements: type, of: Dilatation) -> wp.Kernel:
    """y += K p of the elements that are held from turning over. Each thread does one group; most groups have none."""
    measure = of.measure

    @OF_GROUPS.kernel()
    def add_held(
        # In
        elements: Elements,
        u: wp.array[wp.vec4],
        p: wp.array[wp.vec4],
        groups: GroupNodes,
        found: GroupRows,
        shared: wp.array[wp.vec4],
        # In and out
        y: wp.array[wp.vec4],
    ):
        g = wp.tid()
        if found.factors[g][1] == 0.0:
            return
        for i in range(groups.ranges[g][0], groups.ranges[g][1]):
            t = groups.members[i]
            stiffness = shared[t][0]
            if stiffness != 0.0:
                _, slope = measure(own_gradient(elements, t, u))
                change = stiffness * wp.ddot(slope, own_gradient(elements, t, p))
                scatter(elements, elements.nodes[t], t, -change * slope, y)

    return add_held


@wp.kernel(enable_backward=False)
def add_row_blocks(
    # In
    groups: GroupNodes,
    found: GroupRows,
    # In and out
    blocks: wp.array[wp.mat33],
):
    """The diagonal blocks of c g g^T; a thread a group."""
    g = wp.tid()
    for k in range(first_entry(groups.ends, g), groups.ends[g]):
        v = row_at(found.rows, k)
        wp.atomic_add(blocks, groups.nodes[k], found.factors[g][0] * wp.outer(v, v))
