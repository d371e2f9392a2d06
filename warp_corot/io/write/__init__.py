"""Writers of results for other programs."""

from .paraview import Fields, also_writer, check_also, fields_of

__all__ = ["Fields", "also_writer", "check_also", "fields_of"]
