"""Linear solves with an assembled matrix: block rows of all bodies, and contacts as products of vectors beside them.

A contact that pushes adds sums of c c^T to the matrix, where c couples the nodes that bear it. Entries of the matrix
are stored transposed, as in ``multigrid.values``.
"""

import warp as wp

from warp_corot.kernels.elements.simd8 import constants, headers, native, on_cpu
from warp_corot.kernels.modules import unique_kernel

from .conjugate_gradients import BEGAN, BROKEN, CONVERGED, END, LIMIT, NEGATIVE, RR, RUNNING, WITHIN
from .multigrid.cycle import Rows
from .multigrid.values import inverse_block

wp.set_module_options({"enable_backward": False})

#: These solves leave smoother residuals than multigrid, so the square of the residual must be this much smaller: with
#: blocks on CUDA, and with sweeps on the CPU. To the same residual, bunnies of 5 and 30 kPa were 3.1 and 1.2 times as
#: far off; with 0.1, or with 0.005 in sweeps, a stiff block that spins beside an obstacle still had more strain energy
#: than its rotation gives it.
CLOSER, CLOSER_SWEPT = 0.03, 0.003
#: Solves that end at a share of their first residual need that only if they begin at less than this many times the
#: tolerance, and may be the last of a step.
SETTLED = 30.0
#: Maximum number of nodes that bear a contact: four for each of the four places of a pair of soft surfaces.
PLACES = 16
#: On the CPU the residual's norm is found at least after so many iterations.
RARELY = 16
#: Sums of parts on the CPU are so many places apart, in cache lines of their own.
LINE = 8


@wp.struct
class Couplings:
    """Contacts as products c c^T, [R, PLACES]; the first ``count`` are in use."""

    count: wp.array[wp.int32]  # [1], which may exceed R
    nodes: wp.array2d[wp.int32]  # in the vectors of all worlds; -1 where there is none
    parts: wp.array2d[wp.vec4]  # of c at each node [sqrt(N/m)]
    blocks: wp.array[wp.mat33]  # the diagonal blocks of the sum, by node [N/m]
    single: wp.array[wp.mat33]  # the derivatives of contacts of one node, which are no products, by node [N/m]


@wp.struct
class Division:
    """How threads of the CPU share the rows of a world in parts; see ``native/ssor_cg.h``."""

    nodes: wp.array[wp.int32]  # by row
    rows: wp.array[wp.int32]  # by node
    spans_of: wp.array[wp.int32]  # the number of the span of each row
    spans: wp.array2d[wp.vec2i]  # [levels * parts, pieces] the rows of each level and part, from and to


@wp.struct
class ContactEntries:
    """What contacts add to the rows of a matrix off its diagonal, on the CPU: a list for each row."""

    count: wp.array[wp.int32]  # [1] how many there are
    heads: wp.array[wp.int32]  # the first one of each row; -1: none
    next: wp.array[wp.int32]  # [E] the next one of the same row; -1: none
    columns: wp.array[wp.int32]  # [E]
    blocks: wp.array[wp.mat33]  # [E] transposed [N/m]
    beside_count: wp.array[wp.int32]  # [1]
    beside: wp.array[wp.int32]  # the contacts, as products, that have no entries


@wp.struct
class Solve:
    """The matrix of a solve, and its vectors; see ``native/ssor_cg.h`` and ``native/persistent_cg.h``."""

    worlds: int
    count: int
    entries: int
    per_team: int
    lanes: int
    most: int
    rows: Rows
    planes: wp.array[wp.float32]
    diagonal: wp.array[wp.int32]
    inverses: wp.array[wp.mat33]
    pivots: wp.array[wp.mat33]
    couplings: Couplings
    of_contacts: ContactEntries
    # In and out
    x: wp.array[wp.vec4]
    r: wp.array[wp.vec4]
    scalars: wp.array2d[wp.float64]
    status: wp.array[wp.int32]
    iterations: wp.array[wp.int32]
    # Work
    u: wp.array[wp.vec4]
    p: wp.array[wp.vec4]
    q: wp.array[wp.vec4]
    s: wp.array[wp.vec4]
    added: wp.array[wp.vec4]
    parts: wp.array[wp.float64]
    barriers: wp.array[wp.uint32]
    # On the CPU
    division: Division
    team: wp.uint64


# --- the matrix -------------------------------------------------------------------------------------------------------


@wp.func
def write_planes(world: int, k: int, entries: int, block: wp.mat33, planes: wp.array[wp.float32]):
    """Write the numbers of an entry each to a plane of its own, which CUDA reads."""
    for a in range(3):
        for b in range(3):
            planes[(9 * world + 3 * a + b) * entries + k] = block[a, b]


@wp.kernel(enable_backward=False)
def lay_out(solve: Solve):
    world, k = wp.tid()
    write_planes(world, k, solve.entries, solve.rows.blocks[world * solve.entries + k], solve.planes)


@wp.kernel(enable_backward=False)
def keep_diagonal(solve: Solve, plain: wp.array[wp.mat33]):
    """Keep the diagonal by node."""
    world, k = wp.tid()
    block = solve.rows.blocks[world * solve.entries + solve.diagonal[k]]
    plain[world * solve.count + solve.division.nodes[k]] = block


@wp.kernel(enable_backward=False)
def finish_matrix(
    # In
    begin: int,
    is_new: int,
    plain: wp.array[wp.mat33],
    # In and out
    marks: wp.array[wp.int32],
    solve: Solve,
):
    """From the row ``begin`` on: the diagonal with contacts of one node; with all contacts; and the inverse of that.
    Unless the matrix ``is_new``, only rows that contact changes, or has changed: ``marks`` says which."""
    world, k = wp.tid()
    k += begin
    i = world * solve.count + k
    node = world * solve.count + solve.division.nodes[k]
    couplings = solve.couplings
    touches = wp.trace(couplings.single[node]) > 0.0 or wp.trace(couplings.blocks[node]) > 0.0
    if is_new == 0 and not touches and marks[i] == 0:
        return
    marks[i] = wp.where(touches, 1, 0)
    own = plain[node]
    inverse = wp.mat33()
    whole = wp.mat33()
    if wp.trace(own) > 0.0:
        own += couplings.single[node]
        whole = own + couplings.blocks[node]
        whole = 0.5 * (whole + wp.transpose(whole))
        inverse = inverse_block(whole)
        solve.rows.blocks[world * solve.entries + solve.diagonal[k]] = own
        if solve.planes.shape[0] > 1:
            write_planes(world, solve.diagonal[k], solve.entries, own, solve.planes)
    solve.pivots[i] = whole
    solve.inverses[i] = inverse


# --- contacts ---------------------------------------------------------------------------------------------------------


@wp.func
def root_columns(a: wp.mat33):
    """A matrix G, column by column, with G G^T = a for a symmetric positive semidefinite a (Cholesky)."""
    g = wp.mat33()
    least = 1.0e-6 * (a[0, 0] + a[1, 1] + a[2, 2])
    for j in range(3):
        pivot = a[j, j]
        for k in range(j):
            pivot -= g[j, k] * g[j, k]
        if pivot > least:
            root = wp.sqrt(pivot)
            g[j, j] = root
            for i in range(j + 1, 3):
                v = a[i, j]
                for k in range(j):
                    v -= g[i, k] * g[j, k]
                g[i, j] = v / root
    return g


@wp.func
def begin_coupling(couplings: Couplings):
    """The number of a new product, -1 if there is no room."""
    c = wp.atomic_add(couplings.count, 0, 1)
    if c >= couplings.nodes.shape[0]:
        return -1
    return c


@wp.func
def add_block(node: int, block: wp.mat33, couplings: Couplings):
    """Add the derivative of a contact of one node."""
    wp.atomic_add(couplings.single, node, block)


@wp.func
def couple(c: int, places: int, node: int, part: wp.vec3, couplings: Couplings):
    """Add a node to a product that has ``places``; returns how many it has then."""
    at = int(0)
    while at < places and couplings.nodes[c, at] != node:
        at += 1
    if at == places:
        couplings.nodes[c, at] = node
        couplings.parts[c, at] = wp.vec4()
    couplings.parts[c, at] = couplings.parts[c, at] + wp.vec4(part[0], part[1], part[2], 0.0)
    return wp.max(places, at + 1)


@wp.func
def end_coupling(c: int, places: int, couplings: Couplings):
    for k in range(places):
        part = couplings.parts[c, k]
        v = wp.vec3(part[0], part[1], part[2])
        wp.atomic_add(couplings.blocks, couplings.nodes[c, k], wp.outer(v, v))
    for k in range(places, PLACES):
        couplings.nodes[c, k] = -1


@wp.func
def add_entry(row: int, column: int, block: wp.mat33, found: ContactEntries):
    """Add a block to a row, which is new or has an entry in this column."""
    e = int(found.heads[row])
    while e >= 0:
        if found.columns[e] == column:
            found.blocks[e] = found.blocks[e] + block
            return
        e = found.next[e]
    e = found.count[0]
    found.count[0] = e + 1
    found.columns[e] = column
    found.blocks[e] = block
    found.next[e] = found.heads[row]
    found.heads[row] = e


@wp.kernel(enable_backward=False)
def add_entries(per_team: int, solve: Solve):
    """Write the products of contacts as entries of rows; in one thread. Contacts that couple rows of two threads which
    sweep at the same time, or for which there may be no room, stay ``beside`` the rows. Lists must be empty."""
    count, division, couplings, found = solve.count, solve.division, solve.couplings, solve.of_contacts
    found.count[0] = 0
    found.beside_count[0] = 0
    for c in range(wp.min(couplings.count[0], couplings.nodes.shape[0])):
        places = int(0)
        while places < PLACES and couplings.nodes[c, wp.min(places, PLACES - 1)] >= 0:
            places += 1
        start = (couplings.nodes[c, 0] / count) * count
        fits = bool(found.count[0] + places * places <= found.columns.shape[0])
        if per_team > 1:
            for k in range(places):
                own = division.spans_of[division.rows[couplings.nodes[c, k] - start]]
                for m in range(k):
                    other = division.spans_of[division.rows[couplings.nodes[c, m] - start]]
                    fits = fits and (own == other or own / per_team != other / per_team)
        if not fits:
            found.beside[found.beside_count[0]] = c
            found.beside_count[0] = found.beside_count[0] + 1
        else:
            for k in range(places):
                row = division.rows[couplings.nodes[c, k] - start]
                part = couplings.parts[c, k]
                for m in range(places):
                    if m != k:
                        there = couplings.parts[c, m]
                        block = wp.outer(wp.vec3(there[0], there[1], there[2]), wp.vec3(part[0], part[1], part[2]))
                        add_entry(start + row, division.rows[couplings.nodes[c, m] - start], block, found)


# --- solves -----------------------------------------------------------------------------------------------------------

_NUMBERS = constants(
    RUNNING=int(RUNNING),
    CONVERGED=int(CONVERGED),
    NEGATIVE=int(NEGATIVE),
    LIMIT=int(LIMIT),
    BROKEN=int(BROKEN),
    RR=int(RR),
    END=int(END),
    WITHIN=int(WITHIN),
    BEGAN=int(BEGAN),
    SETTLED=SETTLED,
    CLOSER=CLOSER,
    CLOSER_SWEPT=CLOSER_SWEPT,
    PLACES=PLACES,
    LINE=LINE,
    RARELY=RARELY,
)


_FIELDS = "".join(f"auto& {name} = solve.{name};\n" for name in Solve.vars if name != "team")


@wp.func_native(
    on_cpu(
        _NUMBERS,
        _FIELDS,
        "const address team = solve.team;\n",
        native("ssor_cg"),
        otherwise=_NUMBERS + _FIELDS + native("persistent_cg"),
    )
)
def solve_rows(world: int, solve: Solve): ...


@unique_kernel(native=headers("team"))
def solve(solve: Solve):
    """Iterate from the residual r of x until it is small enough: on the CPU in one thread, which shares the work with
    its team, on CUDA by resident blocks.
    """
    solve_rows(wp.tid(), solve)
