"""What a device holds of a mesh: elements, complete subtrees, the force plan, slots for reproducible sums."""
