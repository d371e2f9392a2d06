"""Kernels of environments for learning."""
