"""Tearing: faces across which the tissue is pulled too hard come apart.

The stress across a face is N S N, with the face's normal N at rest and the second Piola-Kirchhoff stress S of St.
Venant and Kirchhoff in the two leaves, in the mean; rotations do not change it. A face is cut if it is above a bound
and no other face of its leaves is pulled harder, so that a tear runs instead of shattering what is around it.
"""

import warp as wp

from .criteria import green_strain
from .cut import Cuts, add_star, cut_side, face_node, is_cut, meet, star_count
from .cut_surface import Surface
from .mark import Contents, load_state
from .pools import LEAVES, Pools
from .state import Carried

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def list_all(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """List all leaves."""
    for i in range(wp.tid(), pools.counts[LEAVES], threads):
        add_star(i, pools, cuts)


@wp.kernel(enable_backward=False)
def pull_faces(
    # In
    threads: int,
    contents: Contents,
    carried: Carried,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Find the stress of each leaf across its faces, and the leaves on both sides of each."""
    for s in range(wp.tid(), star_count(cuts), threads):
        i = cuts.stars[s]
        element = load_state(pools.leaves[i], carried.origin, carried.spacing, pools, contents, carried.u)
        e = green_strain(element)
        for face in range(4):
            a = element.rest[face_node(face, 0)]
            normal = wp.cross(element.rest[face_node(face, 1)] - a, element.rest[face_node(face, 2)] - a)
            normal = wp.normalize(normal)
            cuts.pull[4 * s + face] = element.lam * wp.trace(e) + 2.0 * element.mu * wp.dot(normal, e * normal)
            meet(s, face, pools.leaf_tets[i], cuts)


@wp.func
def mean_pull(f: int, pools: Pools, cuts: Cuts):
    """The mean stress across a face that holds two leaves together; zero across others."""
    other = cuts.other[f]
    if other < 0 or is_cut(f, pools, cuts):
        return 0.0
    return 0.5 * (cuts.pull[f] + cuts.pull[other])


@wp.kernel(enable_backward=False)
def choose_faces(
    # In
    threads: int,
    surface: Surface,
    pools: Pools,
    # In and out
    cuts: Cuts,
):
    """Choose the faces that tear: those above the bound, and above all others of both leaves."""
    for f in range(wp.tid(), 4 * star_count(cuts), threads):
        other = cuts.other[f]
        cuts.link[f] = 0
        if other > f:
            pull = mean_pull(f, pools, cuts)
            if pull > surface.stress:
                most = float(0.0)
                for n in range(4):
                    most = wp.max(most, mean_pull(4 * (f / 4) + n, pools, cuts))
                    most = wp.max(most, mean_pull(4 * (other / 4) + n, pools, cuts))
                if pull >= most:
                    cuts.link[f] = 1


@wp.kernel(enable_backward=False)
def tear_faces(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Cut the chosen faces."""
    for f in range(wp.tid(), 4 * star_count(cuts), threads):
        if cuts.link[f] == 1:
            cut_side(f, 0, pools, cuts)
            cut_side(cuts.other[f], 1, pools, cuts)
