"""Errors and warnings, each with one clear line."""

import sys
from types import FrameType


class InputError(ValueError):
    """The user's input cannot be used: the message names the thing, its value and what would be right."""


class StaleViewError(InputError):
    """A view of a body's arrays is used after the body's mesh, and so its nodes, changed."""


class UnstableError(RuntimeError):
    """The simulation cannot continue: its state is not finite, has energy from nowhere, or moves too far in a step.

    The message says what was found, and at which step.
    """


class ConvergenceError(RuntimeError):
    """A solve whose answer is needed did not converge: the message says which."""


class StabilityWarning(UserWarning):
    """The simulation continues, but something may be wrong: the message says what.

    The given time step is larger than the stable one, a run was repeated with half the step, bodies overlap at the
    start, elements were turned inside out, or a grasp has nothing left to hold.
    """


class CapacityWarning(UserWarning):
    """A mesh that changes has reached its capacity: it is not refined further, and the simulation continues."""


def depth_of_user() -> int:
    """The number of stack frames from the code that warns up to the user's code.

    ``step`` and ``advance`` have different depths, and Python shows a warning only once for each line of code: it must
    be the user's line, not one of the package.
    """
    frame: FrameType | None = sys._getframe(1)
    depth, package = 1, __name__.partition(".")[0]
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, depth = frame.f_back, depth + 1
    return depth
