"""Structs that kernels read, kept from launch to launch, because making one takes longer than a launch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from warp_corot.kernels.elements.constitutive import IsotropicMaterial

S = TypeVar("S")


class Kept(Generic[S]):
    """The struct of some values, made again if one of these is another object.

    Args:
        make: Makes the struct of the values.
    """

    def __init__(self, make: Callable[..., S]):
        self._make = make
        self._values: tuple = ()
        self._struct: S | None = None

    def __call__(self, *values: object) -> S:
        if self._struct is None or any(a is not b for a, b in zip(values, self._values, strict=True)):
            self._values, self._struct = values, self._make(*values)
        return self._struct


def isotropic_material(given: list) -> IsotropicMaterial:
    """``kernels.elements.constitutive.IsotropicMaterial`` of mu, lambda and their stride."""
    material = IsotropicMaterial()
    material.mu, material.lam, material.stride = given
    return material
