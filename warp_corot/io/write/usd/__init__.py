"""USD stages as output."""
