"""The option ``dilatation`` of models: whether elements share theirs, and the field that follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.elasticity.model import ForceField
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, shown
from warp_corot.inputs.choices import AUTO, ELEMENT, SHARED
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.materials.anisotropic import Anisotropic

from .field import DilatationField

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized

#: Poisson's ratio in any element from which "auto" means "shared".
SHARED_FROM = 0.45


def check_dilatation(dilatation: str) -> None:
    """Check the option of a model.

    Raises:
        InputError: It is none of the values.
    """
    checked_choice(dilatation, "dilatation", (AUTO, ELEMENT, SHARED))


def refuse_shared(dilatation: str, model: str) -> None:
    """Check the option of a model of springs, which has no dilatation to share.

    Raises:
        InputError: It is not "element".
    """
    if not isinstance(dilatation, str) or dilatation != ELEMENT:
        raise InputError(f"dilatation is {shown(dilatation)}; for {model}, which has springs, it must be {ELEMENT!r}")


def shares_dilatation(dilatation: str, discretization: Discretization) -> bool:
    """Whether the elements of a discretization share their dilatation under an option of the model.

    Raises:
        InputError: They should, and the material is anisotropic.
    """
    inseparable = isinstance(discretization.material, Anisotropic)
    if dilatation == SHARED and inseparable:
        name = type(discretization.material).__name__
        raise InputError(f"dilatation is {SHARED!r} and the material is {name}; it must be {AUTO!r} or {ELEMENT!r}")
    if dilatation != AUTO or inseparable:
        return dilatation == SHARED
    # The limit as a float32 number counts, too.
    return float(np.max(discretization.material.poisson)) > SHARED_FROM - 1e-6


def bind_law(
    bind: Callable[[Discretization, bool], ForceField],
    of: Dilatation,
    dilatation: str,
    body: Discretized | Discretization,
    deterministic: bool,
) -> ForceField:
    """The field of a law on a body, with a dilatation of each element or a shared one.

    Args:
        bind: Makes the law's field of a discretization; the other argument is ``deterministic``.
        of: The shared dilatation.
        dilatation: The option of the model.
        body, deterministic: As for every field.

    Raises:
        InputError: The dilatation should be shared, and the material is anisotropic.
    """
    discretization = discretization_of(body)
    if shares_dilatation(dilatation, discretization):
        return DilatationField(discretization, lambda part: bind(part, deterministic), of, deterministic)
    return bind(discretization, deterministic)
