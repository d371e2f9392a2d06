"""Changes of the meshes in a simulation, by planes, tears, blades and passes, and the stable step afterwards."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.options import Contact
from warp_corot.contact.tool import Obstacle
from warp_corot.cutting.blade import Blade, Plane, checked_plane
from warp_corot.cutting.blades import Blades
from warp_corot.discretization.changing.passes import plane_surface
from warp_corot.elasticity import ForceField
from warp_corot.errors import InputError, StabilityWarning, depth_of_user
from warp_corot.inputs.checks import checked_number
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.kernels.remesh.cut_surface import Surface
from warp_corot.remesh.remeshing import OnlineRemesh, Remeshing
from warp_corot.solvers import Integrator, largest_frequency
from warp_corot.solvers.guard import Guard
from warp_corot.solvers.halo import ALONE, Halo
from warp_corot.solvers.system import System

from .energy import Clock
from .parts import check_implicit

#: No element of an isotropic material alone vibrates faster than the square root of this many times its modulus
#: 2 mu + lambda over its density and squared size, whatever its shape and Poisson's ratio; and no mesh of elements does
#: (Irons and Treharne 1971), cut or not.
FASTEST = 8.0


class Cutting(Clock):
    """The part of a simulation that changes its meshes.

    Attributes:
        bodies, parts, fields, integrator, ranks, grasps, system, remeshing, guard: The simulation's.
        contact, blades: None without.
        stable_dt: As of ``Simulation``.
        stable_steps: The same of each body.
    """

    bodies: tuple[SoftBody, ...]
    parts: tuple[SoftBody, ...]
    fields: tuple[ForceField, ...]
    integrator: Integrator
    ranks: Halo = ALONE
    system: System
    remeshing: Remeshing
    guard: Guard
    contact: Contacts | None
    blades: Blades | None
    stable_dt: float
    stable_steps: list[float]

    def _make(
        self,
        remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
        touching: tuple[tuple[Obstacle, ...], Contact] | None,
        blades: tuple[Blade, ...] | None,
    ) -> None:
        raise NotImplementedError

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        """The grasps that hold now."""
        return tuple(each for each in self.system.constraints if isinstance(each, Grasp))

    @under_lock
    def cut(self, plane: Plane, body: SoftBody | None = None) -> float:
        """Cut bodies along a plane, at once and where they are now.

        Faces of elements are separated that are nearest to the plane; ``body.pieces`` says how many pieces there are
        afterwards. A simulation made without ``cuts`` is prepared for cutting by its first cut.

        Args:
            plane: The plane.
            body: The body; None: all.

        Returns:
            The area of the cut, at rest [m^2]; zero if the plane meets nothing.

        Raises:
            InputError: It is not a plane, the body is not one of this simulation's, a body cannot be cut (see
                ``remesh.Changing``), or the simulation was made without ``cuts`` and remeshes bodies, has grasps or
                added forces.

        Warns:
            CapacityWarning: The mesh has no room left for the nodes of a cut; once.
        """
        found = checked_plane(plane)
        return self._cut(plane_surface(found.normal, found.offset, is_deformed=True), body)

    @under_lock
    def tear(self, stress: float, body: SoftBody | None = None) -> float:
        """Separate faces of elements across which bodies are pulled too hard, at once.

        Of all faces of an element only the one that is pulled most tears in a call, so that tears run:
        ``sim.on_step(lambda sim: sim.tear(2e4), every=10)``.

        Args:
            stress: The largest normal stress that a face bears, second Piola-Kirchhoff of an isotropic law [Pa].
            body: The body; None: all.

        Returns:
            The area that has come apart, at rest [m^2].

        Raises:
            InputError: The stress is not positive, or as ``cut``.

        Warns:
            CapacityWarning: As ``cut``.
        """
        if not 0.0 < checked_number(stress, "stress", "Pa") < math.inf:
            raise InputError(f"stress is {stress}; it must be a positive number [Pa]")
        return self._cut(float(stress), body)

    def follow_motion(self) -> bool:
        """Cut and remesh the bodies that are due, and adapt the step to the new meshes; returns whether meshes may have
        changed."""
        steps, blades = self.steps, self.blades
        changed = False
        if blades is not None and blades.is_due(steps):
            changed = blades.cut()
            if changed:
                self._bound_step()
            elif blades.has_settled:
                self._find_step()
        if self.remeshing.run(steps):
            changed = True
            self._control_step()
            if blades is not None:
                blades.bind_again()
        return changed

    @property
    def changes_every(self) -> tuple[int, ...]:
        """The numbers of steps after whose multiples ``follow_motion`` is due."""
        found = (self.remeshing.every, 0 if self.blades is None else self.blades.every)
        return tuple(every for every in found if every)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _find_stable_steps(self) -> list[float]:
        """The largest stable step of each body at rest [s]; ``stable_dt`` is the smallest of them."""
        if self.integrator.is_implicit:
            self.stable_dt = math.inf
            self.stable_steps = [math.inf] * len(self.bodies)
            return self.stable_steps
        bound = enumerate(zip(self.parts, self.fields, strict=True))
        frequencies = [largest_frequency(body, f.stiffest, self.ranks, k) for k, (body, f) in bound]
        added = self._added_curvature
        steps = [self.integrator.stable_step(math.sqrt(frequency**2 + added)) for frequency in frequencies]
        self.stable_dt, self.stable_steps = min(steps), steps
        given = self.integrator.dt
        if given is not None and float(given) > self.stable_dt:
            warnings.warn(
                f"the time step {float(given):.3g} s is beyond the largest stable one, about {self.stable_dt:.3g} s",
                StabilityWarning,
                stacklevel=depth_of_user(),
            )
        return steps

    def _cut(self, surface: Surface | float, body: SoftBody | None) -> float:
        number = None if body is None else self._index(body)
        self._prepare_cuts()
        area = self.remeshing.cut(surface, number)
        if area > 0.0:
            self._find_step()
            self.guard.forget()
        return area

    def _find_step(self) -> None:
        """Find the stable step of the present meshes."""
        stable = self._find_stable_steps()
        if self.safe_step is not None:
            self.safe_step.find_rest(stable)

    def _bound_step(self) -> None:
        """Make the step no longer than any cut of the present elements allows, which takes no search."""
        if self.safe_step is None or self.integrator.is_implicit:
            return
        stable = list(self.stable_steps)
        for k, changing in enumerate(self.remeshing.changing):
            if changing is not None:
                square = FASTEST * changing.survey.stiffness + self._added_curvature
                stable[k] = min(stable[k], self.integrator.stable_step(math.sqrt(square)))
        if stable != self.stable_steps:
            self.stable_dt, self.stable_steps = min(stable), stable
            self.safe_step.find_rest(stable)

    def _prepare_cuts(self) -> None:
        """Let bodies be cut, if the simulation was not made so."""
        if self.remeshing.are_cut:
            return
        if self.remeshing.every or self.grasps or self.system.forces or not self.ranks.is_alone:
            raise InputError("the simulation was not made for cuts; Simulation(..., cuts=[]) makes one that is")
        if self.integrator.is_implicit:
            check_implicit(self.integrator, remeshes=True, ordered=False)
        former = self.contact
        touching = None if former is None else (former.obstacles.given, former.options)
        if former is not None:
            former.obstacles.let_go()
        try:
            self._make(None, touching, ())
        except BaseException:
            if former is not None:
                former.obstacles.take_back()
            raise
        if former is not None and self.contact is not None:
            self.contact.obstacles.continue_from(former.obstacles)

    def _control_step(self) -> None:
        """Find the stable step again if other elements now limit it."""
        if self.remeshing.step_may_change():
            self._find_step()

    @property
    def _added_curvature(self) -> float:
        return sum(getattr(each, "curvature", 0.0) for each in self.system.forces)

    def _index(self, body: SoftBody | None) -> int:
        if body is None:
            return 0
        if not isinstance(body, SoftBody) or body not in self.bodies:
            raise InputError("the body is not one of this simulation's")
        return self.bodies.index(body)
