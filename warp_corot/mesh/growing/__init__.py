"""Forests grown from bodies: the choice of sizes and levels, and elements cut by the surface."""
