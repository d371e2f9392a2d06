"""Laws whose elements share their dilatation, so that nearly incompressible tissue does not lock."""

from .options import ELEMENT, SHARED, bind_law, check_dilatation, refuse_shared

__all__ = ["ELEMENT", "SHARED", "bind_law", "check_dilatation", "refuse_shared"]
