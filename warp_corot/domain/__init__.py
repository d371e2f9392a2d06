"""Bodies to be meshed: signed functions from surfaces, segmented scans, formulas, and sets of these."""

from .domain import Domain
from .labels import labels_from_probabilities

__all__ = ["Domain", "labels_from_probabilities"]
