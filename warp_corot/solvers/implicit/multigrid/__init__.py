"""Geometric multigrid on the bisection tree, as a preconditioner."""

from .multigrid import Multigrid

__all__ = ["Multigrid"]
