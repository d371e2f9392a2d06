"""USD stages as input."""
