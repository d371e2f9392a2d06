"""What goes wrong, in one clear line each."""


class InputError(ValueError):
    """What the user gave cannot be used: the message names the thing, its value and what would be right."""


class UnstableError(RuntimeError):
    """The state is no longer finite: the message names the step at which this was seen."""


class StabilityWarning(UserWarning):
    """The time step is beyond what the explicit integrator can hold."""
