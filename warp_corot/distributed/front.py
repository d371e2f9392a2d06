"""A simulation of whole bodies, as on one process; all ranks make its steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.reading import ContactPoint
from warp_corot.errors import InputError, UnstableError
from warp_corot.simulation.simulation import Simulation as OnOne

from . import mpi
from .simulation import Simulation


class LedSimulation(OnOne):
    """A simulation of whole bodies on every rank, for writers and tables; rank 0 leads it.

    Rank 0 uses it like any other simulation. The other ranks call ``serve``, which makes the steps that rank 0 asks
    for. After each call all nodes are up to date on all ranks.

    Args:
        bodies, options: As for ``warp_corot.Simulation``.

    Raises:
        InputError: As for ``warp_corot.distributed.Simulation``.
    """

    def __init__(self, bodies: SoftBody | Sequence[SoftBody], **options: Any):
        self._comm = mpi.world()
        options = {name: value for name, value in options.items() if value is not None}
        self._on_all = Simulation(bodies, **options)
        touching = {"obstacles", "contact"}
        super().__init__(bodies, **{name: value for name, value in options.items() if name not in touching})
        # Each tool is in one simulation.
        self.contact = self._on_all.contact
        self._served = False

    # --- stepping --------------------------------------------------------------------------------------------------

    def step(self) -> None:
        self.advance_steps(1)

    def advance(self, seconds: float) -> None:
        self.advance_until(self.total_time + seconds)

    def advance_until(self, total_time: float) -> None:
        self._lead("advance_until", total_time)

    def advance_steps(self, count: int) -> None:
        self._lead("advance_steps", count)

    def on_step(self, callback: Callable[[OnOne], None], every: int = 1) -> None:
        def called(_: object) -> None:
            self._on_all.collect()
            callback(self)

        self._on_all.on_step(called, every)

    def reset(self, worlds: Any = None) -> None:
        raise InputError("reset does not work where rank 0 leads others")

    def contacts(self) -> list[ContactPoint]:
        raise InputError("contacts does not work where rank 0 leads others")

    def save(self, path: Any) -> None:
        raise InputError("save does not work where rank 0 leads others")

    # --- leading ---------------------------------------------------------------------------------------------------

    def serve(self) -> None:
        """On ranks other than 0: make the steps that rank 0 asks for until it is done.

        Raises:
            UnstableError: As on rank 0.
        """
        while (told := self._comm.unwatched.bcast(None, root=0)) is not None:
            self._make(*told)

    def end(self) -> None:
        """On rank 0: release the other ranks once, whatever has ended the run."""
        if not self._served:
            self._served = True
            self._comm.bcast(None, root=0)

    def _lead(self, name: str, amount: float) -> None:
        self._comm.bcast((name, amount), root=0)
        self._make(name, amount)

    def _make(self, name: str, amount: float) -> None:
        try:
            getattr(self._on_all, name)(amount)
        except UnstableError:
            # All ranks have the same error and end without a message.
            self._served = True
            raise
        finally:
            if not self._served:
                self._on_all.collect()

    # --- the clock -------------------------------------------------------------------------------------------------

    @property
    def dt(self) -> float:
        return self._on_all.dt

    @property
    def dt_range(self) -> tuple[float, float]:
        return self._on_all.dt_range

    @property
    def steps(self) -> int:
        return self._on_all.steps

    @property
    def total_steps(self) -> int:
        return self._on_all.total_steps

    @property
    def time(self) -> float:
        return self._on_all.time

    @property
    def total_time(self) -> float:
        return self._on_all.total_time
