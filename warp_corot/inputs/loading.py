"""Kernels compiled and loaded several modules at a time, before their first launches.

Warp compiles a module when one of its kernels is first launched: one after another, on one core. The modules named here
are those that every run of a kind launches; fields name the kernels that factories made for them.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from importlib import import_module
from typing import TypeAlias

import warp as wp

from .cpu_threads import core_count
from .stopwatch import KERNELS, WATCH

#: Modules of ``warp_corot.kernels`` for closed surfaces and for meshes of domains, the slowest to compile first.
SURFACES = ("meshing.domain", "meshing.windings")
MESHING = ("meshing.domain", "meshing.elements", "meshing.embedding", "meshing.growth")
#: Modules for bodies, for all steps, and for explicit ones whose length is chosen.
BODY = ("plan.plan", "plan.batches", "stepping.team", "elements.cpu", "stepping.integrate")
STEPS = ("stepping.balance", "stepping.pace")
STEPS_ON_CPU = ("subtrees.degenerate", *STEPS, "stepping.subnormals")
EXPLICIT = ("stepping.stability",)
#: Modules for implicit steps, and for those of bodies on forests.
IMPLICIT = (
    *("implicit.steps", "implicit.residual", "elements.mean_dilatation_rows", "implicit.tangent"),
    *("implicit.conjugate_gradients", "implicit.increments", "elements.elements"),
)
IMPLICIT_ON_FORESTS = (
    *("implicit.multigrid.values", "implicit.multigrid.pattern"),
    *("implicit.assembled", "implicit.multigrid.cycle", "implicit.lagged"),
)
#: Modules for explicit contact, besides its solver; and those for soft surfaces on the CPU.
CONTACT = ("contact.explicit_step", "contact.sums", "contact.beside", "contact.watch", "contact.bearing")
CONTACT_ON_CPU = ("contact.approach", "contact.explicit_step", "contact.sums", "contact.watch", "contact.bearing")
PAIRS_ON_CPU = ("contact.rows", "contact.wide_tree", "contact.beside", "contact.motion")

#: A kernel, or one with the number of threads of its blocks on CUDA, if that is not Warp's default.
LoadedKernel: TypeAlias = wp.Kernel | tuple[wp.Kernel, int]

#: What was begun: modules by device and number of threads.
_begun: dict[tuple[wp.Module, str, int | None], Future] = {}
#: When loading began [s].
_since: list[float] = []


def begin_loading(names: Iterable[str], device: wp.Device, kernels: Iterable[LoadedKernel] = ()) -> list[Future]:
    """Begin to load modules of kernels, and modules of ``warp_corot.kernels``, in other threads and in this order.

    A module with a ``BLOCK`` is loaded for so many threads of a block."""
    files = [import_module(f"warp_corot.kernels.{name}") for name in names]
    modules = [(wp.get_module(file.__name__), getattr(file, "BLOCK", None)) for file in files]
    pairs = [each if isinstance(each, tuple) else (each, None) for each in kernels]
    found = []
    for module, threads in (*((kernel.module, threads) for kernel, threads in pairs), *modules):
        key = (module, str(device), threads)
        if key not in _begun:
            _since[:] = _since or [time.monotonic()]
            _begun[key] = _threads().submit(wp.load_module, module, device, block_dim=threads)
        found.append(_begun[key])
    return found


def progress() -> tuple[int, int, float | None] | None:
    """The number of modules that have been loaded, that of all that are asked for so far, and an estimate of the time
    left [s], once a quarter are loaded, since the slowest come first; None if all are loaded."""
    done, count = sum(each.done() for each in _begun.values()), len(_begun)
    if done == count:
        return None
    left = (time.monotonic() - _since[0]) * (count - done) / max(done, 1)
    return done, count, left if 4 * done >= count else None


def load(names: Iterable[str], device: wp.Device, kernels: Iterable[LoadedKernel] = ()) -> None:
    """Load modules as `begin_loading` does, and wait for them."""
    wait_for(begin_loading(names, device, kernels))


def wait_for(modules: Iterable[Future]) -> None:
    """Wait for modules that are being loaded."""
    try:
        with WATCH.part(KERNELS):
            for module in modules:
                module.result()
    except BaseException:
        give_up()
        raise


def give_up(settled: bool = False) -> None:
    """Load none of the modules that wait for a thread, otherwise Python would load them before it ends; and wait for
    those that are being loaded, if ``settled``, as Python would."""
    for key in [key for key, module in _begun.items() if module.cancel()]:
        del _begun[key]
    if settled:
        wait(_begun.values())


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(min(core_count(), 8), thread_name_prefix="compiling")
