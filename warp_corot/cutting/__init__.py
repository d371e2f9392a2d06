"""Cutting: planes that cut at once, and blades that cut while they move."""
