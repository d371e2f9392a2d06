"""Kernels that a process launches to exchange values with others."""
