"""A simulation of whole bodies on rank 0, as on one process; all ranks make its steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.reading import ContactPoint
from warp_corot.errors import InputError, UnstableError
from warp_corot.simulation.clock import Clock
from warp_corot.simulation.simulation import Simulation as OnOne
from warp_corot.simulation.solves import Solves

from . import mpi
from .part_sync import STATE
from .scatter_bodies import handed_bodies
from .simulation import Simulation


class Workers:
    """The simulation of all ranks, which rank 0 leads; the others call ``serve``.

    Args:
        on_all: The simulation of all ranks.
        wholes: On rank 0, the whole bodies of which ``on_all`` has parts; None: every rank holds the whole bodies.
        nodes: On rank 0, the nodes of each rank's part of each of these.
    """

    def __init__(
        self,
        on_all: Simulation,
        wholes: Sequence[SoftBody] | None = None,
        nodes: Sequence[Sequence[npt.NDArray[np.int64]]] = (),
    ):
        self.on_all, self.comm = on_all, on_all.comm
        self._wholes, self._nodes = wholes, nodes
        self._in_parts = any(each.is_in_parts for each in on_all.syncs)
        #: Callbacks of rank 0, or of all ranks that hold the whole bodies; and how many there are on any rank.
        self._callbacks: list[Callable[[], None]] = []
        self._called = 0
        self._served = False

    @classmethod
    def joined(cls, device: str | wp.Device | None) -> Workers:
        """On ranks other than 0: the simulation of parts of the bodies that rank 0 hands out.

        Raises:
            InputError: As on rank 0.
        """
        bodies, options, _ = handed_bodies(None, None, device, mpi.world())
        return cls(Simulation(bodies, **options))

    def serve(self) -> None:
        """On ranks other than 0: make the steps that rank 0 asks for until it is done.

        Raises:
            UnstableError: As on rank 0.
        """
        while (told := self.comm.unwatched.bcast(None, root=0)) is not None:
            self._make(*told)

    def end(self) -> None:
        """On rank 0: release the other ranks once, whatever has ended the run."""
        if not self._served:
            self._served = True
            self.comm.bcast(None, root=0)

    def lead(self, name: str, amount: Any) -> None:
        """On rank 0: call a method of the simulation on all ranks, with one argument."""
        self.comm.bcast((name, amount), root=0)
        self._make(name, amount)

    def on_step(self, callback: Callable[[], None], every: int) -> None:
        """On rank 0, or on all ranks that hold the whole bodies: call back after steps, with all nodes up to date."""
        self._callbacks.append(callback)
        if self._in_parts:
            self.lead("_call_back", every)
        else:
            self._call_back(every)

    def _call_back(self, every: int) -> None:
        number = self._called
        self._called += 1

        def called(_: object) -> None:
            self.collect()
            if self._callbacks:
                self._callbacks[number]()
            self._hand_out_loads()

        self.on_all.on_step(called, every)

    def collect(self) -> None:
        """Bring the state of all nodes into the whole bodies; all ranks must call this."""
        if not self._in_parts:
            self.on_all.collect()
            return
        for k, each in enumerate(self.on_all.syncs):
            for name in STATE:
                found = each.gather(getattr(each.whole.state, name))
                if self._wholes is not None:
                    assert found is not None
                    state = self._wholes[k].state
                    getattr(state, name)[: len(found)].assign(found)
            if self._wholes is not None:
                self._wholes[k].state.publish_positions()

    def _hand_out_loads(self) -> None:
        """Give the parts the loads of the whole bodies; all ranks must call this."""
        if not self._in_parts:
            return
        given: list[list[npt.NDArray[np.float32] | None]] | None = None
        if self._wholes is not None:
            loads = [each.loads.numpy() if each.conditions.has_loads else None for each in self._wholes]
            given = [[None if a is None else a[n] for a, n in zip(loads, own, strict=True)] for own in self._nodes]
        for body, values in zip(self.on_all.bodies, self.comm.scatter(given, root=0), strict=True):
            if values is not None:
                body.loads.assign(values)

    def _make(self, name: str, amount: Any) -> None:
        if name.startswith("_"):
            getattr(self, name)(amount)
            return
        self._hand_out_loads()
        try:
            getattr(self.on_all, name)(amount)
        except UnstableError:
            # All ranks have the same error and end without a message.
            self._served = True
            raise
        finally:
            if not self._served:
                self.collect()


class RootSimulation(OnOne):
    """A simulation of whole bodies, for writers and tables; rank 0 leads it.

    Rank 0 uses it like any other simulation. The other ranks call ``serve``, which makes the steps that rank 0 asks
    for. After each call all nodes of the whole bodies are up to date.

    Args:
        bodies, options: As for ``warp_corot.Simulation``.
        in_parts: Whether only rank 0 makes this, and hands out parts of the bodies to the others, which call
            ``Workers.joined``; otherwise every rank makes this with the whole bodies.

    Raises:
        InputError: As for ``warp_corot.distributed.Simulation``.
    """

    def __init__(self, bodies: SoftBody | Sequence[SoftBody], *, in_parts: bool = False, **options: Any):
        options = {name: value for name, value in options.items() if value is not None}
        if in_parts and options.get("remesh"):
            raise InputError("remeshing does not work where rank 0 hands out parts; every rank must make the body")
        elsewhere = {"obstacles", "contact", "remesh"}
        # Each tool is in one simulation, and one simulation changes a mesh.
        super().__init__(bodies, **{name: value for name, value in options.items() if name not in elsewhere})
        if in_parts:
            wholes = [bodies] if isinstance(bodies, SoftBody) else list(bodies)
            parts, _, nodes = handed_bodies(lambda: wholes, lambda _: options, wholes[0].device, mpi.world())
            self._workers = Workers(Simulation(parts, **options), wholes, nodes)
        else:
            self._workers = Workers(Simulation(bodies, **options))
        if (remeshing := self._workers.on_all.remeshing) is not None:
            self.remeshing, self.fields = remeshing
        self.serve, self.end = self._workers.serve, self._workers.end

    # --- stepping --------------------------------------------------------------------------------------------------

    def step(self) -> None:
        self.advance_steps(1)

    def advance(self, seconds: float) -> None:
        self.advance_until(self.total_time + seconds)

    def advance_until(self, total_time: float) -> None:
        self._workers.lead("advance_until", total_time)

    def advance_steps(self, count: int) -> None:
        self._workers.lead("advance_steps", count)

    def on_step(self, callback: Callable[[OnOne], None], every: int = 1) -> None:
        self._workers.on_step(lambda: callback(self), every)

    def reset(self, worlds: Any = None) -> None:
        self._workers.lead("reset", worlds)

    def save(self, path: Any) -> None:
        self._workers.lead("save", path)

    def contacts(self) -> list[ContactPoint]:
        raise InputError("contacts does not work where rank 0 leads others")

    @property
    def contact(self) -> Contacts | None:
        """The contact of all ranks, which is another one after the mesh has changed."""
        return self._workers.on_all.contact

    @contact.setter
    def contact(self, given: Contacts | None) -> None:
        assert given is None

    @property
    def clock(self) -> Clock:
        return self._workers.on_all.clock

    @property
    def solves(self) -> Solves | None:
        return self._workers.on_all.solves
