"""Writers of results for other programs."""

from .fields import Fields, fields_of
from .paraview import also_writer, check_also

__all__ = ["Fields", "also_writer", "check_also", "fields_of"]
