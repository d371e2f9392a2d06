"""A pass over a forest that changes."""
