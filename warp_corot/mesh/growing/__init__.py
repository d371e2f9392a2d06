"""Forests grown from bodies: how fine, how large, and what the surface cuts."""
