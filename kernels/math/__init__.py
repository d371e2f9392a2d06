"""Small matrices, and the rotations in them."""
