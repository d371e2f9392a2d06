"""How many nodes and elements a body has, and how many its launches go through."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Sizes:
    """Counts of a mesh on the device; those of a mesh that changes follow it.

    Attributes:
        worlds: Copies of the body.
        world_nodes, world_elements: In one copy.
        launch_nodes, launch_elements: How many launches go through; those beyond the counts do nothing.
        version: Changes whenever the mesh does.
        revision: Changes whenever launches go through other arrays or other numbers of things.
    """

    worlds: int
    world_nodes: int
    world_elements: int
    launch_nodes: int
    launch_elements: int
    version: int = 0
    revision: int = 0

    @classmethod
    def of(cls, worlds: int, nodes: int, elements: int) -> Sizes:
        """Of so many copies of a mesh that stays as it is."""
        return cls(worlds, nodes, elements, worlds * nodes, worlds * elements)

    @property
    def nodes(self) -> int:
        """Nodes of all worlds."""
        return self.worlds * self.world_nodes

    @property
    def elements(self) -> int:
        """Elements of all worlds."""
        return self.worlds * self.world_elements

    def mesh_changed(self, nodes: int, elements: int) -> None:
        """The mesh has changed, and has so many nodes and elements now."""
        self.world_nodes, self.world_elements = nodes, elements
        self.version += 1

    def set_launches(self, nodes: int, elements: int) -> bool:
        """Go through so many nodes and elements from now on; whether these are other numbers than before."""
        before = self.launch_nodes, self.launch_elements
        self.launch_nodes, self.launch_elements = nodes, elements
        return before != (nodes, elements)

    def relaunch(self) -> None:
        """Launches of a step are others from now on."""
        self.revision += 1
