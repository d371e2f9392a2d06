"""What goes wrong, in one clear line each."""

import sys
from types import FrameType


class InputError(ValueError):
    """What the user gave cannot be used: the message names the thing, its value and what would be right."""


class StaleViewError(InputError):
    """A view of a body's arrays is used after the body's mesh has changed: there are other nodes now."""


class UnstableError(RuntimeError):
    """The state is no longer finite: the message names the step at which this was seen."""


class StabilityWarning(UserWarning):
    """The time step is beyond what the explicit integrator can hold."""


class CapacityWarning(UserWarning):
    """A mesh that changes has no room left: it is refined no further, and the simulation goes on."""


def depth_of_user() -> int:
    """How many calls above the one that warns the first is that is not this package's.

    ``step`` is not as deep as ``advance``, and what is said at a line of the package is said there once for all
    simulations.
    """
    frame: FrameType | None = sys._getframe(1)
    depth, package = 1, __name__.partition(".")[0]
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, depth = frame.f_back, depth + 1
    return depth
