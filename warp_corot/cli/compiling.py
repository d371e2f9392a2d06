"""A message that kernels are being compiled, at the start of the first compilation.

Warp reports a module only when it is compiled. But it makes a folder in its kernel cache for each module that it
begins to compile, and for none that it finds there; and Python reports every new folder to audit hooks (PEP 578).
"""

from __future__ import annotations

import functools
import os
import sys
from contextlib import suppress
from typing import Any

import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.device import checked_device
from warp_corot.inputs.loading import BODY, begin_loading
from warp_corot.inputs.stopwatch import KERNELS, WATCH

from .exit_status import complain

#: The device of which the next compilation is said; "" for none.
_device = ""
#: Whether this process has compiled kernels; otherwise they were in Warp's cache.
has_compiled = False


def tell_compiling(device: wp.Device) -> None:
    """Say in one line that kernels are compiled for a device, as soon as any are; say nothing if all are in Warp's
    cache."""
    global _device
    _listen()
    _device = str(device)


def begin_compiling(device: str | None) -> None:
    """Begin to load what all runs launch, while Python imports the rest; that a device is not there is said later."""
    _listen()
    with suppress(InputError):
        begin_loading(BODY, checked_device(device))


@functools.cache
def _listen() -> None:
    """Install the audit hook, and let the stopwatch count Warp's loading of modules; cached, since hooks cannot be
    removed."""
    sys.addaudithook(_heard)
    load = wp.Module.load

    @functools.wraps(load)
    def counted(*args: Any, **options: Any) -> Any:
        with WATCH.part(KERNELS):
            return load(*args, **options)

    wp.Module.load = counted


def _heard(event: str, args: tuple[Any, ...]) -> None:
    global has_compiled, _device
    if event == "os.mkdir" and _in_kernel_cache(args[0]):
        has_compiled = True
        device, _device = _device, ""
        if device:
            complain(f"compiling kernels for {device}, once: this takes some seconds ...", kind="")


def _in_kernel_cache(path: Any) -> bool:
    cache = wp.config.kernel_cache_dir  # set when Warp starts
    return bool(cache) and os.fsdecode(path).startswith(os.path.join(cache, ""))
