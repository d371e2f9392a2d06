"""Small matrices and their rotations."""
