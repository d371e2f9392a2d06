"""Online remeshing: a forest that refines and simplifies on the device while the tissue deforms.

``DeviceForest`` holds the tree, its leaves and nodes in pools of fixed capacity, with what they carry; ``RemeshPass``
is one pass over it:

1. *Mark*: a criterion of each leaf's state, by default the elongation of its longest edge, against two thresholds.
2. *Close and bisect*: the refinement edges of marked leaves are wanted. A leaf with a wanted edge that is not its
   refinement edge wants that one too; an edge that is the refinement edge of all leaves around it is bisected. Each
   such bisection leaves the mesh conforming, so that full pools stop refinement without undoing any of it.
3. *Simplify*: a node goes if all leaves that name it were made with it and are marked.
4. *Order*: the list of leaves is rewritten in tree order, so that complete subtrees stand side by side.

A pass is recorded once and replayed. It has no host round trip: counts stay on the device, loops run until nothing is
wanted any more (conditional nodes of the graph on CUDA), and every launch goes through what there is, not through what
there might be. On CUDA without conditional nodes the host asks once a round whether to go on.

What is carried (``Carriage``): a new node is the midpoint of its deformed edge and takes mass and momentum from both
ends; removal is the reverse and keeps mass and linear momentum to rounding, supports being accounted for. Angular
momentum and kinetic energy are not kept exactly where velocities vary along an edge. Quantities of elements are per
full rest volume: children have their parent's, a parent the mean of its children's. Children with different labels are
not merged. Void tetrahedra stay as they are, and a node that one of them names stays too: a mesh made from a domain is
not simplified beyond the void beside it, and its marched surface is that of the mesh it began as.

Nodes are told apart by their numbers and edges by those of their ends, never by lattice points, so that several nodes
may share one.

How a simulation is to use it (not there yet)::

    sim = wc.Simulation(body, remesh=wc.OnlineRemesh(refine_above=1.25, simplify_below=1.08, every=10, capacity=10**6))

- ``OnlineRemesh`` is a frozen dataclass of ``RemeshPass``'s options, ``capacity`` and ``every``.
- The body's ``node_displacements``, ``node_velocities``, ``node_loads``, ``node_mass`` and ``node_inverse_mass`` become
  ``carriage.arrays``' ``u``, ``v``, ``load``, ``mass32`` and ``inverse_mass``: arrays of ``node_capacity``, stepped up
  to ``counts[NODE_TOP]``. Free places have no mass and move nowhere. Constraints become ``held``.
- mu and lambda times the filled share, activation and directions are ``values`` of elements, gathered by ``leaves``.
- After a pass in which ``counts[ADDED] + counts[REMOVED]`` is not zero the force plan is derived anew from ``leaves``,
  ``leaf_tets`` and ``level``, the body's ``revision`` goes up, and ``stable_dt`` is found again if the finest level has
  changed.
- ``body.mesh`` is ``DeviceForest.to_forest()`` on demand; bound surfaces are embedded anew.
- ``is_full`` is looked at where the state is checked, and said once.
"""

from .passes import RemeshPass
from .pools import DeviceForest
from .transfer import Carriage

__all__ = ["Carriage", "DeviceForest", "RemeshPass"]
