"""What goes wrong, in one clear line each."""


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
