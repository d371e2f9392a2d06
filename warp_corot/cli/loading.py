"""``--pull``, ``--twist`` and ``--press``: loads on a body over time."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.domain.units import in_units
from warp_corot.errors import InputError
from warp_corot.inputs.keys import checked_times

from .options.defaults import LOADS
from .pressing import pressed, surface_of

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

    from .patches import BodyPatches

#: Units of values that have none.
UNITS = {"pull": "m", "twist": "degree", "press": "Pa"}
#: Largest angle between keyframes of a twist [degrees]: nodes move straight in between.
KEY_ANGLE = 5.0

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Load:
    """A load on a patch.

    Attributes:
        kind: "pull", "twist" or "press".
        patch: The expression.
        values: Displacement [m], angle [degrees] or pressure [Pa].
        times: Increasing [s]; () for a ramp whose length is given elsewhere.
        shares: Fractions of the values at these times; linear in between, constant before and after.
        axis: Axis of a twist; None: the mean normal of the patch's surface.
    """

    kind: str
    patch: str
    values: tuple[float, ...]
    times: tuple[float, ...] = ()
    shares: tuple[float, ...] = ()
    axis: tuple[float, float, float] | None = None

    def curve(self, ramp: float) -> tuple[Array, Array]:
        """Times [s] and fractions at them.

        Raises:
            InputError: Their numbers differ, or times do not increase.
        """
        if not self.times:
            return np.array([0.0, ramp]), np.array([0.0, 1.0])
        times, shares = checked_times(self.times), np.asarray(self.shares, dtype=np.float64)
        if shares.shape != times.shape or not np.isfinite(shares).all():
            raise InputError(f"{self.kind}: shares are {list(self.shares)}; they must be one number for each time")
        return times, shares

    def __str__(self) -> str:
        return f"--{self.kind} {self.patch!r} {' '.join(f'{value:g}' for value in self.values)}"


def loads_of(args: argparse.Namespace) -> list[Load]:
    """The loads in the options.

    Raises:
        InputError: A value is not a number.
    """
    found = list(getattr(args, "curves", ()))
    for kind in LOADS:
        for patch, *texts in getattr(args, kind) or ():
            try:
                found.append(Load(kind, patch, tuple(value_of(kind, text) for text in texts)))
            except InputError as error:
                raise InputError(f"--{kind} {patch!r} {' '.join(texts)}: {error}") from None
    if args.ramp is not None:
        if not (math.isfinite(args.ramp) and args.ramp > 0.0):
            raise InputError(f"--ramp is {args.ramp:g} s; it must be a positive time")
        if not found:
            raise InputError("--ramp is for --pull, --twist and --press, none of which is given")
    return found


def ramp_of(args: argparse.Namespace, duration: float) -> float:
    """The time over which loads grow [s]."""
    return 0.5 * duration if args.ramp is None else args.ramp


def value_of(kind: str, text: str) -> float:
    """A displacement [m], an angle [degrees] or a pressure [Pa], from a number with or without a unit.

    Raises:
        InputError: It is not a number.
    """
    value = in_units(text, UNITS[kind])
    if not math.isfinite(value):
        raise InputError(f"{text} must be a finite number")
    return value


def move_patches(
    body: SoftBody, loads: Sequence[Load], patches: BodyPatches, ramp: float, fixed: npt.NDArray[np.bool_] | None
) -> None:
    """Prescribe the motion of the patches of ``--pull`` and ``--twist``.

    Args:
        body: The body.
        loads: Its loads.
        patches: Its patches.
        ramp: Time over which loads without times grow [s].
        fixed: Nodes of ``--fix``, bool [N]; None if it was not given. If a patch moves, its nodes among these move,
            too.

    Raises:
        InputError: A patch without nodes, or without a direction if one is needed; a node in two patches; or a
            patch with all nodes fixed.
    """
    taken = np.zeros(len(patches.subject.mesh.points), bool)
    for load in loads:
        if load.kind == "press":
            continue
        mask = patches.some(load.patch, f"--{load.kind}")
        if (mask & taken).any():
            raise InputError(f"{load}: {int((mask & taken).sum())} of its nodes are moved by another option, too")
        taken |= mask
        both = 0 if fixed is None else int((mask & fixed).sum())
        if both == mask.sum():
            raise InputError(f"{load}: all of its nodes are held by --fix")
        if both:
            patches.subject.notes.append(f"{load}: {both} of its nodes are named by --fix, too, and move")
        times, shares = load.curve(ramp)
        if load.kind == "pull":
            moves = shares[:, None] * load.values
        else:
            times, moves = _turned(load, patches, mask, times, shares)
        body.prescribe(mask, times=times, displacements=moves)
    if taken.sum() == len(patches.used):
        raise InputError("all nodes are moved by options; at least one must be free to move")


def _turned(
    load: Load, patches: BodyPatches, mask: npt.NDArray[np.bool_], times: Array, shares: Array
) -> tuple[Array, Array]:
    """Keyframes of a twist: times [K], and displacements [K, n, 3]."""
    axis = (
        -pressed(load, patches, surface_of(patches)).sum(axis=0)
        if load.axis is None
        else np.asarray(load.axis, dtype=np.float64)
    )
    length = np.linalg.norm(axis)
    if not (np.isfinite(axis).all() and length > 0.0):
        raise InputError(f"{load}: has no axis; it must be three numbers, not all zero")
    from scipy.spatial.transform import Rotation

    fine = [times[:1]]
    for start, end, span in zip(times, times[1:], np.abs(np.diff(shares)) * abs(load.values[0]), strict=False):
        fine.append(np.linspace(start, end, 1 + max(1, math.ceil(span / KEY_ANGLE)))[1:])
    keys = np.concatenate(fine)
    angles = np.radians(load.values[0]) * np.interp(keys, times, shares)
    points = patches.subject.mesh.points[mask]
    arms = points - points.mean(axis=0)
    return keys, np.stack([Rotation.from_rotvec(angle * axis / length).apply(arms) - arms for angle in angles])
