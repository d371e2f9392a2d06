"""Which arrays of the pools and of what is carried belong to nodes, and which to tetrahedra."""

#: Of ``kernels.remesh.pools.Pools``; what a pass leaves behind for nobody is left out.
OF_NODES: tuple[str, ...] = ("lattice", "ends", "valence")
OF_TETRAHEDRA: tuple[str, ...] = ("tets", "level", "parent", "first_child", "code")

#: Of ``kernels.remesh.state.Carried``.
CARRIED_BY_NODES: tuple[str, ...] = (
    "rest",
    "u",
    "v",
    "load",
    "reaction",
    "mass",
    "held",
    "row",
    "mass32",
    "inverse_mass",
)
CARRIED_BY_TETRAHEDRA: tuple[str, ...] = ("density", "label", "values", "numbers")
