"""Forces for the hand: a loop with its own clock between a haptic device and a tool of a simulation."""

from .devices import Device, DeviceError, MouseDevice, ScriptedDevice
from .loop import HapticLoop, Report

__all__ = ["Device", "DeviceError", "HapticLoop", "MouseDevice", "Report", "ScriptedDevice"]
