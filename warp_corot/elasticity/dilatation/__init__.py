"""Laws whose elements share their dilatation, so that nearly incompressible tissue does not lock."""

from .options import AUTO, ELEMENT, SHARED, SHARED_FROM, bind_law, check_dilatation, refuse_shared

__all__ = ["AUTO", "ELEMENT", "SHARED", "SHARED_FROM", "bind_law", "check_dilatation", "refuse_shared"]
