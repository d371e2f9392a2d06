"""Online remeshing: a forest that refines and simplifies on the device while the tissue deforms.

For users: ``OnlineRemesh`` says when elements are refined and simplified; ``elongation``, ``strain``,
``von_mises_stress`` and ``nearness`` are its criteria. Your own criterion is a ``@wp.func`` of an ``ElementState``
and an array of float32; it may call ``displacement_gradient``, ``green_strain`` and ``longest_edge``.

``pools.DeviceForest`` holds the tree, its leaves and nodes in pools of fixed capacity, with the data that they carry;
``passes.RemeshPass`` is one pass over it:

1. *Mark*: a criterion of each leaf's state, by default the elongation of its longest edge, against two thresholds.
2. *Close and bisect*: the refinement edges of marked leaves are wanted. If a leaf has a wanted edge that is not its
   refinement edge, its refinement edge is wanted too; an edge that is the refinement edge of all leaves around it is
   bisected. Each bisection leaves the mesh conforming, so full pools stop refinement without undoing any of it.
3. *Simplify*: a node is removed if all leaves that name it were made with it and are marked.
4. *Number*: the last nodes move into the places of removed ones, so that N nodes are 0 … N - 1.
5. *Order*: the list of leaves is rewritten in tree order, so that complete subtrees are contiguous.

A pass is recorded once and replayed. It has no host round trip: counts stay on the device, loops run until no edge is
wanted (conditional nodes of the graph on CUDA), and every launch runs over the current size, not over the capacity.
On CUDA without conditional nodes the host decides once a round whether to continue.

What is carried (``transfer.Carriage``): a new node is the midpoint of its deformed edge and takes mass and momentum
from both ends; removal is the reverse and keeps mass and linear momentum to rounding, supports included.
Angular momentum and kinetic energy are not kept exactly if velocities vary along an edge. Quantities of elements are
per full rest volume: children have their parent's values, a parent the mean of its children's. In an anisotropic
material a parent has its first child's axes and the mean of both stiffnesses, weighted by what each child holds;
active stress is treated alike, with the keyframes that it follows (``carried_material``). Children with different
labels are not merged. Void tetrahedra do not change, and a node of a void tetrahedron stays too: a mesh made from a
domain is not simplified where that would change the void, and its marched surface is that of the initial mesh.

Nodes are identified by their numbers and edges by the numbers of their ends, never by lattice points, so that several
nodes may share one.

In a simulation (``Simulation(…, remesh=OnlineRemesh(…))``, ``changing.Changing``) the body uses the nodal arrays of the
carriage. After the pass the same recording derives the force plan (``plan.DevicePlan``) and finds the stiffest
element. Then the host reads a few numbers once: whether the mesh has changed, and how large launches must
be. Launches are a little larger than the mesh, so that steps are recorded again only when counts leave
their bounds. The rest is padding: nodes without mass, and elements on nodes that never move, whose forces are
zero.
"""

from warp_corot.kernels.remesh.criteria import (
    ElementState,
    displacement_gradient,
    elongation,
    green_strain,
    longest_edge,
    nearness,
    strain,
    von_mises_stress,
)

from .remeshing import OnlineRemesh

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
