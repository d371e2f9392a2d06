"""Which bodies of a simulation are remeshed, and when."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.contact.shapes import Box, Capsule, Cylinder, Sphere
from warp_corot.contact.tool import FITTING, Tool
from warp_corot.discretization.changing.passes import (
    checked_capacity,
    checked_criterion,
    checked_parameters,
    checked_thresholds,
)
from warp_corot.errors import CapacityWarning, InputError, depth_of_user
from warp_corot.inputs.checks import checked_count, shown
from warp_corot.inputs.choices import REFINE_ABOVE, REMESH_EVERY, SIMPLIFY_BELOW
from warp_corot.kernels.remesh.criteria import nearness
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import MAX_LEVEL, check_levels
from warp_corot.mesh.surfaces.bound import NOT_OPENED

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.cutting.blade import Blade
    from warp_corot.elasticity import ForceField, Model
    from warp_corot.kernels.remesh.cut_surface import Surface
    from warp_corot.remesh.changing import Changing

#: Longest edge over the edge of a root cube and over 2^(-level / 3), of the shape where that is largest.
LONGEST = 1.79
#: How the longest edge grows with the distance from a tool.
SLOPE = 0.6


@dataclass(frozen=True, eq=False)
class OnlineRemesh:
    """Refinement and simplification while a simulation runs; see ``warp_corot.remesh``.

    Every ``every`` steps a pass evaluates all elements. It bisects an element whose criterion is above
    ``refine_above``, and merges two siblings if both are below ``simplify_below`` and their parent would not be refined
    again. Between the thresholds nothing happens. A pass bisects an element once, and again if conformity requires it.
    An element with less than half its volume inside the body is only refined for conformity.

    Children have their parent's material, fibre direction and active stress. A parent has the mean
    of its children's stiffness, density and active stress, but its first child's directions, and that child's active
    stress if the two follow different keyframes.

    ``Simulation.reset()`` restores the mesh of the initial state, with the last loads, held nodes and motions of that
    mesh: those given on other meshes are lost.

    Attributes:
        refine_above, simplify_below: Thresholds in the criterion's unit; the first is the larger one. By default they
            apply to the elongation of an element's longest edge, deformed over rest length (Tagawa et al. 2013).
        min_level, max_level: Elements at these levels are not simplified and not refined, 0 to 48; three levels halve
            the edge length. None: the mesh is nowhere coarser than at the start, and at most three levels finer than
            its finest, or as fine as ``near`` asks.
        every: Steps between passes.
        capacity: Largest number of elements; None: four times those of the mesh, at least 100,000. When it is
            reached, refinement stops with one warning, and the simulation continues.
        criterion: ``remesh.strain``, ``von_mises_stress`` or ``nearness`` in place of the elongation, or your own Warp
            function (``@wp.func``) of a ``remesh.ElementState`` and an array of numbers.
        parameters: These numbers, float32 [n] on the simulation's device. You may write to them between steps. The
            criterion must not read beyond them: kernels do not check.
        near: A tool of the simulation, in place of a criterion: elements are refined where their longest edge is longer
            than a quarter of the tool's radius, or of half its thickness, and 0.6 of their distance from it. The
            thresholds are in units of that length, times 1.25.

    Raises:
        InputError: Thresholds that cannot both hold, levels out of order or beyond the lattice's depth, a criterion
            that is not a Warp function or has other arguments, too few parameters, a number of steps or elements
            that is not positive, or ``near`` is no tool of a simple shape or stands beside a criterion.
    """

    refine_above: float = REFINE_ABOVE
    simplify_below: float = SIMPLIFY_BELOW
    min_level: int | None = None
    max_level: int | None = None
    every: int = REMESH_EVERY
    capacity: int | None = None
    criterion: Any = None
    parameters: wp.array | None = None
    near: Tool | None = None

    def __post_init__(self) -> None:
        checked_thresholds(self.refine_above, self.simplify_below)
        check_levels(self.min_level, self.max_level)
        checked_count(self.every, "every", least=1)
        if self.capacity is not None:
            checked_count(self.capacity, "capacity", least=1)
        if self.criterion is not None:
            checked_criterion(self.criterion)
        checked_parameters(self.parameters, self.criterion)
        if self.near is not None:
            if not (isinstance(self.near, Tool) and isinstance(self.near.shape, Sphere | Capsule | Cylinder | Box)):
                raise InputError(
                    f"near is {shown(self.near)}; it must be a Tool: a ball, a capsule, a cylinder or a box"
                )
            if self.criterion not in (None, nearness):
                raise InputError("near and criterion are two criteria; one of them must be None")

    @property
    def place(self) -> list[float]:
        """The parameters of ``nearness`` for the tool where it is now, [13]; waits for the device."""
        tool = self.near
        assert tool is not None
        size, shape = tool.shape.size, tool.shape
        pose = tool.pose if tool.is_free else tool.present_pose[0]
        half, radius = {
            Sphere: ((0.0, 0.0, 0.0), size[0]),
            Capsule: ((0.0, 0.0, size[1]), size[0]),
            Cylinder: ((size[0], size[0], size[1]), 0.0),
            Box: (size, 0.0),
        }[type(shape)]
        return [*pose[:3], *half, radius, FITTING * shape.thickness / REFINE_ABOVE, *pose[3:], SLOPE / REFINE_ABOVE]

    def _asked_level(self, mesh: TetForest) -> int:
        """The level whose edges are as short as the tool asks."""
        if self.near is None:
            return 0
        return math.ceil(3.0 * math.log2(LONGEST * mesh.cell_size / (FITTING * self.near.shape.thickness)))

    def on(self, mesh: TetForest) -> OnlineRemesh:
        """The same options with all defaults but ``min_level`` filled in from a mesh.

        Raises:
            InputError: The mesh has more elements than ``capacity``.
        """
        count, high = len(mesh.tets), self.max_level
        if high is None:
            high = min(max(int(mesh.levels.max()) + 3, self.min_level or 0, self._asked_level(mesh)), MAX_LEVEL)
        capacity = max(4 * count, 100_000) if self.capacity is None else self.capacity
        return replace(self, max_level=high, capacity=checked_capacity(capacity, count))


class Remeshing:
    """The passes of a simulation.

    Args:
        bodies, models: The simulation's.
        asked: The user's argument: options for all bodies or one entry for each.
        deterministic: Whether runs must be reproducible bit for bit.
        blades: The blades that cut bodies, if any can be cut.

    Attributes:
        changing: The remeshing and cutting of each body; None for bodies whose mesh never changes.
        every: Steps after which a pass may be due; 0 if there is none.

    Raises:
        InputError: The argument has another type, or these bodies and models cannot be remeshed.
    """

    def __init__(
        self,
        bodies: Sequence[SoftBody],
        models: Sequence[Model],
        asked: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
        *,
        deterministic: bool,
        blades: Sequence[Blade] | None = None,
    ):
        are_cut = blades is not None
        if any(body.changing is not None for body in bodies):
            raise InputError(
                "a body that one simulation remeshes or cuts cannot be in another; make a SoftBody of its mesh"
            )
        options = _one_each(asked, len(bodies))
        self.every = math.gcd(*(int(each.every) for each in options if each is not None))
        self.are_cut = are_cut
        self.changing: tuple[Changing | None, ...] = (None,) * len(bodies)
        if not self.every and not are_cut:
            return
        if deterministic and bodies[0].device.is_cuda:
            raise InputError(
                "a deterministic run on CUDA cannot be remeshed or cut: threads number new nodes in any order"
            )
        from .changing import Changing, fitted

        level = max((blade.level for blade in blades or () if blade.level is not None), default=None)
        # All checks come before the first body is given pools: an error leaves the bodies unchanged.
        for each, body, model in zip(options, bodies, models, strict=True):
            if each is not None or are_cut:
                body.check_own_arrays()
                if are_cut and any(binding.normals is not None for binding in body.bindings):
                    raise InputError(NOT_OPENED)
                if model.kept_of_elements is not None:
                    raise InputError(
                        f"{model.kept_of_elements}; a body that is remeshed or cut must have another model"
                    )
                fitted(each or OnlineRemesh(), body)

        self.changing = tuple(
            Changing(body, each, model.carried, is_cut=are_cut, level=level) if each is not None or are_cut else None
            for each, body, model in zip(options, bodies, models, strict=True)
        )
        self._said_full: set[int] = set()

    @property
    def changed(self) -> tuple[Changing, ...]:
        """The remeshing and cutting of the bodies whose mesh changes."""
        return tuple(each for each in self.changing if each is not None)

    def serve(self, fields: Sequence[ForceField]) -> None:
        """Connect the bodies' force fields, which now exist, to the pools."""
        for changing, field in zip(self.changing, fields, strict=True):
            if changing is not None:
                changing.serve(field)

    def is_due(self, steps: int) -> bool:
        """Whether any pass is due after this number of steps."""
        return self.every > 0 and steps % self.every == 0

    def run(self, steps: int) -> bool:
        """Make the passes that are due after this number of steps; returns whether there was any.

        Warns:
            CapacityWarning: A body's capacity does not suffice for the refinement; once.
        """
        due = [c for c in self.changing if c is not None and c.is_remeshed and steps % c.options.every == 0]
        for changing in due:
            changing.run()
            self._say_full(changing)
        return bool(due)

    def cut(self, surface: Surface | float, number: int | None = None) -> float:
        """Cut all bodies, or one, along a surface or where the stress is above a number [Pa]; returns the area [m^2].

        Warns:
            CapacityWarning: As ``run``.
        """
        chosen = self.changing if number is None else self.changing[number : number + 1]
        area = 0.0
        for changing in chosen:
            if changing is not None:
                area += changing.cut(surface)
                self._say_full(changing)
        return area

    def _say_full(self, changing: Changing) -> None:
        if changing.is_full and id(changing) not in self._said_full:
            self._said_full.add(id(changing))
            most = f"{changing.options.capacity} elements"
            message = f"the mesh has reached its capacity of {most}; it is not refined or cut further"
            warnings.warn(message, CapacityWarning, stacklevel=depth_of_user())

    def step_may_change(self) -> bool:
        """Whether the stable step must be found again; call it once after each pass."""
        return any([changing.survey.step_may_change() for changing in self.changing if changing is not None])


def _one_each(
    asked: OnlineRemesh | Sequence[OnlineRemesh | None] | None, count: int
) -> tuple[OnlineRemesh | None, ...]:
    if isinstance(asked, OnlineRemesh | None):
        return (asked,) * count
    given = tuple(asked) if isinstance(asked, Sequence) else ()
    if len(given) != count or not all(isinstance(each, OnlineRemesh | None) for each in given):
        raise InputError(
            f"remesh is {shown(asked)}; it must be an OnlineRemesh, or one or None for each of {count} bodies"
        )
    return given
