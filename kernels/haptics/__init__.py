"""Kernels of haptics."""
