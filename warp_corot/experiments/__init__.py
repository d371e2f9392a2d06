"""A suite of cases with known answers: elastic laws, contact, friction and impacts, each beside its reference."""

from . import elastic, half_spaces, motion  # noqa: F401  (each adds its cases)
from .case import CASES, Case, Row, Setup, run_case

__all__ = ["CASES", "Case", "Row", "Setup", "run_case"]
