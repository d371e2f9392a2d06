"""Complete three-level subtrees of the forest, the unit of work of the fast force path.

Three bisections halve all six edges of a tetrahedron. Its eight leaves have ten nodes, the four corners and the six
midpoints, and are of its own type again. The type alone decides which leaf uses which of the ten: a table that kernels
are generated from. Only the ten node numbers are data: forces are summed in registers and each subtree adds to 10 nodes
in place of 32. Eight subtrees under one ancestor six levels up share nodes once more: 35 (37 under type 2) in place of
80.

Plain Python tables, as ``shapes``.
"""

import itertools

from warp_corot.kernels.elements.shapes import STIFFNESS_LAMBDA, STIFFNESS_MU

from .shapes import GRADIENT, REST

Point = tuple[float, float, float]


def descendants(shape: int, depth: int) -> tuple[list[tuple[int, ...]], list[Point]]:
    """Leaves ``depth`` levels below an element of a type, in tree order and by local node numbers in Maubach order.

    Also the positions of these nodes in the element's Maubach frame for an edge length of one; the first four are its
    own."""
    positions: list[Point] = list(REST[shape])
    midpoints: dict[tuple[int, int], int] = {}

    def middle(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in midpoints:
            midpoints[key] = len(positions)
            (ax, ay, az), (bx, by, bz) = positions[a], positions[b]
            positions.append(((ax + bx) / 2, (ay + by) / 2, (az + bz) / 2))
        return midpoints[key]

    leaves: list[tuple[int, ...]] = [(0, 1, 2, 3)]
    for level in range(shape, shape + depth):
        k = 3 - level % 3
        halves = []
        for x in leaves:
            z = middle(x[0], x[k])
            halves += [(*x[:k], z, *x[k + 1 :]), (*x[1 : k + 1], z, *x[k + 1 :])]
        leaves = halves
    return leaves, positions


def _frames(shape: int) -> list[list[Point]]:
    """Maubach frame of each of the eight leaves in the subtree's own: three columns each."""
    leaves, x = descendants(shape, 3)

    def column(leaf: tuple[int, ...], c: int) -> Point:
        a, b, d = (2.0 * sum(GRADIENT[shape][c][n] * x[leaf[n]][axis] for n in range(4)) for axis in range(3))
        return a, b, d

    return [[column(leaf, c) for c in range(3)] for leaf in leaves]


def _handedness(columns: list[Point]) -> float:
    a, b, c = columns
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return 1.0 if sum(p * q for p, q in zip(cross, c, strict=True)) > 0 else -1.0


#: The four of the ten nodes that each of the eight leaves stands on [type][8][4].
LEAVES = tuple(descendants(shape, 3)[0] for shape in range(3))
#: The ten nodes in the subtree's Maubach frame, edge length one [type][10].
POSITIONS = tuple(descendants(shape, 3)[1] for shape in range(3))
#: Maubach frame of each leaf in the subtree's: [type][8] three columns.
FRAMES = tuple(_frames(shape) for shape in range(3))
#: 1 where a leaf's Maubach frame has the handedness of the subtree's, else -1 [type][8].
HANDEDNESS = tuple([_handedness(frame) for frame in FRAMES[shape]] for shape in range(3))


def stiffness(shape: int) -> tuple[list[list[float]], list[list[float]]]:
    """The 30x30 stiffness of a whole subtree of a uniform isotropic material, in its Maubach frame and over its edge
    length: the parts that lambda and mu multiply. It has about 40 nonzeros a leaf; the paper has 74 to 100.
    """
    parts = []
    for table in (STIFFNESS_LAMBDA[shape], STIFFNESS_MU[shape]):
        total = [[0.0] * 30 for _ in range(30)]
        for leaf, frame in zip(LEAVES[shape], FRAMES[shape], strict=True):
            for i, a, j, b in itertools.product(range(4), range(3), range(4), range(3)):
                # B K B^T, half as large since a leaf's edge is half the subtree's.
                entry = 0.5 * sum(
                    frame[c][a] * table[3 * i + c][3 * j + d] * frame[d][b]
                    for c, d in itertools.product(range(3), range(3))
                )
                total[3 * leaf[i] + a][3 * leaf[j] + b] += entry
        parts.append(total)
    return parts[0], parts[1]


#: Node numbers kept for a group of eight subtrees, -1 past its 35 or 37.
GROUP_NODES = 40
#: Subtree slots have this spacing in shared memory, so that the eight lanes of a group use different banks.
SLOT_STRIDE = 11


def group_nodes(shape: int) -> list[tuple[int, int]]:
    """Where to read a group's nodes, busiest first: (leaf of 64, local node of 4) for each."""
    leaves, _ = descendants(shape, 6)
    places: dict[int, tuple[int, int]] = {}
    for at, leaf in enumerate(leaves):
        for n, node in enumerate(leaf):
            places.setdefault(node, (at, n))
    return [places[node] for node in _busiest_first(shape)]


def _members(shape: int) -> list[list[int]]:
    """The ten nodes of each of a group's eight subtrees, as nodes of the group in order of creation."""
    leaves, _ = descendants(shape, 6)
    members = []
    for subtree in range(8):
        ten = [-1] * 10
        for at, leaf in enumerate(LEAVES[shape]):
            for slot, node in zip(leaf, leaves[8 * subtree + at], strict=True):
                ten[slot] = node
        members.append(ten)
    return members


def _busiest_first(shape: int) -> list[int]:
    members = _members(shape)
    count = [sum(node in ten for ten in members) for node in range(len(descendants(shape, 6)[1]))]
    return sorted(range(len(count)), key=lambda node: -count[node])


def group_leaves(shape: int) -> list[list[int]]:
    """The four nodes of each of a group's 64 leaves, as places in ``group_nodes``."""
    place = {node: at for at, node in enumerate(_busiest_first(shape))}
    return [[place[node] for node in leaf] for leaf in descendants(shape, 6)[0]]


def group_slots(shape: int) -> list[list[int]]:
    """For each of the eight subtrees of a group its ten nodes, as places in ``group_nodes``."""
    place = {node: at for at, node in enumerate(_busiest_first(shape))}
    return [[place[node] for node in ten] for ten in _members(shape)]


def group_sources(shape: int) -> list[list[int]]:
    """For each node of a group the slots in shared memory, subtree * SLOT_STRIDE + local node, that add up there."""
    sources: list[list[int]] = [[] for _ in range(GROUP_NODES)]
    for subtree, ten in enumerate(group_slots(shape)):
        for local, place in enumerate(ten):
            sources[place].append(subtree * SLOT_STRIDE + local)
    return sources
