"""Marking of leaves for refinement or simplification: a criterion of the element's state against two thresholds."""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.meshing.bisection import refinement_end
from warp_corot.kernels.modules import unique_kernel

from .pools import LEAVES, REFINE, SIMPLIFY, Pools

#: Fraction of its volume inside the body below which an element is refined only for conformity: most of what is
#: stretched there is not tissue, and its halves would hold almost no mass.
LEAST_FILL = 0.5

mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@wp.struct
class ElementState:
    """The state of an element for a criterion, with its nodes in Maubach order."""

    level: int
    corner: wp.vec3  # rest position of node 0 [m]
    rest: mat43  # rest positions relative to node 0, a row for each node [m]
    moved: mat43  # displacements, a row for each node [m]
    mu: float  # Lamé's parameters [Pa] of the nearest isotropic material
    lam: float


@wp.struct
class Contents:
    """Material data of tetrahedra for marking; columns of ``Carried.values``, or -1."""

    values: wp.array2d[wp.float32]
    mu: float  # Lamé's parameters of all elements if they are equal and have no columns
    lam: float
    mu_column: int
    lam_column: int
    fill_column: int


@wp.func
def elongation(element: ElementState, parameters: wp.array[wp.float32]):
    """Deformed over rest length of the longest edge, which is the refinement edge (Tagawa et al. 2013)."""
    k = refinement_end(element.level)
    edge = element.rest[k]
    change = element.moved[k] - element.moved[0]
    return wp.length(edge + change) / wp.length(edge)


@wp.func
def load_state(
    e: int,
    origin: wp.vec3d,
    spacing: wp.float64,
    pools: Pools,
    contents: Contents,
    u: wp.array[wp.vec4],
):
    """The state of a tetrahedron, a leaf or an ancestor, for a criterion."""
    state = ElementState()
    tet = pools.tets[e]
    p = pools.lattice[tet[0]]
    state.level = pools.level[e]
    state.corner = wp.vec3(
        float(origin[0] + wp.float64(p[0]) * spacing),
        float(origin[1] + wp.float64(p[1]) * spacing),
        float(origin[2] + wp.float64(p[2]) * spacing),
    )
    size = float(spacing)
    rest = mat43()
    moved = mat43()
    for n in range(4):
        q = pools.lattice[tet[n]] - p
        rest[n] = size * wp.vec3(float(q[0]), float(q[1]), float(q[2]))
        moved[n] = load_node(u, tet[n])
    state.rest = rest
    state.moved = moved
    state.mu = contents.mu
    state.lam = contents.lam
    if contents.mu_column >= 0:
        state.mu = contents.values[e, contents.mu_column]
        state.lam = contents.values[e, contents.lam_column]
    return state


@wp.func
def holds_enough(e: int, contents: Contents):
    """Whether an element may be refined if conformity does not require it."""
    if contents.fill_column < 0:
        return True
    return contents.values[e, contents.fill_column] >= wp.static(LEAST_FILL)


@functools.cache
def marking_kernel(criterion: Any) -> wp.Kernel:
    """The kernel that marks leaves by a criterion: a Warp function of an ``ElementState`` and an array of numbers.

    A leaf is not merged if its parent would be refined at once: edges of an element and of its halves have different
    directions, so that one may be stretched and the other not.
    """

    @unique_kernel()
    def mark_leaves(
        # In
        threads: int,
        refine_above: float,
        simplify_below: float,
        origin: wp.vec3d,
        spacing: wp.float64,
        u: wp.array[wp.vec4],
        parameters: wp.array[wp.float32],
        contents: Contents,
        # In and out
        pools: Pools,
    ):
        for i in range(wp.tid(), pools.counts[LEAVES], threads):
            e = pools.leaves[i]
            value = criterion(load_state(e, origin, spacing, pools, contents, u), parameters)
            mark = wp.int8(0)
            if value > refine_above:
                if holds_enough(e, contents):
                    mark = REFINE
            elif value < simplify_below and pools.parent[e] >= 0:
                above = criterion(load_state(pools.parent[e], origin, spacing, pools, contents, u), parameters)
                if above <= refine_above:
                    mark = SIMPLIFY
            pools.marks[i] = mark

    return mark_leaves
