"""Forests grown from bodies, and points in them."""
