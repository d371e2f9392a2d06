"""Surfaces of meshes, and points and surfaces that are bound to them."""
