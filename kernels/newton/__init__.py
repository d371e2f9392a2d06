"""Tetrahedra, contacts and particles of a Newton model."""
