"""Kernels of the page: hands that pull on a surface, and values at its points."""
