"""Explicit integrators, and launches that make many steps."""
