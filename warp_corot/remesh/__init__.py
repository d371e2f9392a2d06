"""Online remeshing: a forest that refines and simplifies on the device while the tissue deforms.

For users: ``OnlineRemesh`` says when elements are refined and simplified; ``elongation``, ``strain``,
``von_mises_stress`` and ``nearness`` are its criteria. A criterion of your own is a ``@wp.func`` of an ``ElementState``
and an array of float32; it may call ``displacement_gradient``, ``green_strain`` and ``longest_edge``.

``pools.DeviceForest`` holds the tree, its leaves and nodes in pools of fixed capacity, with what they carry;
``passes.RemeshPass`` is one pass over it:

1. *Mark*: a criterion of each leaf's state, by default the elongation of its longest edge, against two thresholds.
2. *Close and bisect*: the refinement edges of marked leaves are wanted. A leaf with a wanted edge that is not its
   refinement edge wants that one too; an edge that is the refinement edge of all leaves around it is bisected. Each
   such bisection leaves the mesh conforming, so that full pools stop refinement without undoing any of it.
3. *Simplify*: a node goes if all leaves that name it were made with it and are marked.
4. *Number*: the last nodes move into the places of those that went, so that N nodes are 0 … N - 1.
5. *Order*: the list of leaves is rewritten in tree order, so that complete subtrees stand side by side.

A pass is recorded once and replayed. It has no host round trip: counts stay on the device, loops run until nothing is
wanted any more (conditional nodes of the graph on CUDA), and every launch goes through what there is, not through what
there might be. On CUDA without conditional nodes the host asks once a round whether to go on.

What is carried (``transfer.Carriage``): a new node is the midpoint of its deformed edge and takes mass and momentum
from both ends; removal is the reverse and keeps mass and linear momentum to rounding, supports being accounted for.
Angular momentum and kinetic energy are not kept exactly where velocities vary along an edge. Quantities of elements are
per full rest volume: children have their parent's, a parent the mean of its children's. Of an anisotropic material a
parent has its first child's axes, and the mean of both stiffnesses counted by what each child holds; active stress goes
the same way, with the keyframes that it follows (``carried_material``). Children with different labels are not merged.
Void tetrahedra stay as they are, and a node that one of them names stays too: a mesh made from a domain is not
simplified beyond the void beside it, and its marched surface is that of the mesh it began as.

Nodes are told apart by their numbers and edges by those of their ends, never by lattice points, so that several nodes
may share one.

In a simulation (``Simulation(…, remesh=OnlineRemesh(…))``, ``changing.Changing``) the body's nodal arrays are those of
the carriage. After the pass the same recording derives the force plan (``plan.DevicePlan``) and finds the stiffest
element. Then the host looks once, at a handful of numbers: whether anything has changed, and how large launches must
be. Launches go through a little more than there is, so that recorded steps are recorded anew only when counts leave
their bounds. What lies beyond is padding: nodes without mass, and elements on places that never move, whose forces are
zero.
"""

from warp_corot.kernels.remesh.criteria import (
    displacement_gradient,
    green_strain,
    longest_edge,
    nearness,
    strain,
    von_mises_stress,
)
from warp_corot.kernels.remesh.mark import ElementState, elongation

from .online import OnlineRemesh

__all__ = [
    "ElementState",
    "OnlineRemesh",
    "displacement_gradient",
    "elongation",
    "green_strain",
    "longest_edge",
    "nearness",
    "strain",
    "von_mises_stress",
]
