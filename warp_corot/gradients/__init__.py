"""Gradients of quantities of a body's motion or rest, by adjoint solves."""
