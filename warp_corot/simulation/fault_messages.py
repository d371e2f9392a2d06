"""Messages about a state that went wrong."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Protocol

from warp_corot.elasticity import StVenantKirchhoff

if TYPE_CHECKING:
    from warp_corot.solvers.guard import Fault
    from warp_corot.solvers.pace import Pace


class Stepped(Protocol):
    """The part of a simulation that a message reads."""

    worlds: int
    models: tuple[Any, ...]
    pace: Pace
    stable_dt: float
    safe_step: Any
    integrator: Any

    @property
    def steps(self) -> int: ...

    @property
    def time(self) -> float: ...


def fault_message(sim: Stepped, fault: Fault, returns: int) -> str:
    """What went wrong, when, and what would help; after the step was halved this many times."""
    more = f" and {len(fault.worlds) - 3} more" if len(fault.worlds) > 3 else ""
    where = f" in world {', '.join(map(str, fault.worlds[:3]))}{more}" if sim.worlds > 1 else ""
    if fault.step is None:
        when = f"at step {sim.steps} (t = {sim.time:.4g} s)"
    else:
        when = f"since step {fault.step} (t = {sim.pace.time_at(fault.step):.4g} s)"
    steps = f"dt is {sim.pace.dt:.3g} s"
    if math.isfinite(sim.stable_dt):
        steps += f", the largest stable step at rest about {sim.stable_dt:.3g} s"
    return f"{fault.what} {when}{where}; {steps}{_advice(sim, returns)}"


def _advice(sim: Stepped, returns: int) -> str:
    if any(getattr(model, "rotation_level", None) is not None for model in sim.models):
        return "; shared rotations have no energy, so that strong bending may need rotation_level=None"
    if any(isinstance(model, StVenantKirchhoff) for model in sim.models):
        return "; StVenantKirchhoff has no energy barrier against being crushed: take NeoHookean or Corotated"
    if sim.integrator.is_implicit:
        return ": take a shorter step, or a tolerance, so that steps are solved by more than one iteration"
    if sim.safe_step is None:
        return ": take a shorter step, or dt=None, which follows the state"
    return f"; {returns} times half the step did not help: look for loads or motions that crush the body"
