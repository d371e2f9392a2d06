"""The device's data of a mesh: elements, complete subtrees, the force plan, slots for reproducible sums."""
