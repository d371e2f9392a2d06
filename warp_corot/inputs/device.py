"""Devices by name."""

from __future__ import annotations

import warp as wp

from warp_corot.errors import InputError

from .checks import shown


def checked_device(device: str | wp.Device | None) -> wp.Device:
    """The device with this name; Warp's default for None.

    Raises:
        InputError: There is no device with this name; the message lists the devices that exist.
    """
    wp.init()
    try:
        found = wp.get_device(device)
    except Exception:
        found = None
    if found is None:
        there = ", ".join(str(d) for d in wp.get_devices())
        raise InputError(f"there is no device {shown(str(device))} here; there is: {there}")
    return found
