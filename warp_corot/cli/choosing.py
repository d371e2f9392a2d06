"""The choice between explicit and implicit steps, if the user makes none."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_corot.elasticity import Corotated
from warp_corot.mesh import TetForest

from .bodies import RunBody
from .implicit import is_static
from .options.defaults import IMPLICIT_DT
from .ranks import are_several
from .touching import RunContact

#: The steps that follow the state, over the largest stable one at rest.
SHORTER = 0.75
#: Bodies with shorter stable steps than this [s] are left to the explicit ones, which refuse them.
SHORTEST = 1e-12
#: Steps up to this length [s] are explicit if users give it.
LONG = 2e-3
#: Implicit steps are chosen if they are faster by this factor, since explicit ones resolve more of the motion.
FASTER = 2.0


@dataclass(frozen=True)
class Cost:
    """What a step takes [s]: at least, for each element, and the factor of both with contact."""

    least: float
    element: float
    touching: float

    def of(self, elements: int, touches: bool) -> float:
        return (self.least + self.element * elements) * (self.touching if touches else 1.0)


#: Explicit and implicit steps of organs on a CPU core, and on an H200. They are rough: the choice must not depend on
#: how busy a machine is.
ON_CPU = Cost(3e-5, 25e-9, 2.4), Cost(1e-3, 0.7e-6, 6.0)
ON_CUDA = Cost(12e-6, 25e-12, 40.0), Cost(1.5e-3, 50e-9, 3.0)


def choose_steps(args: argparse.Namespace, bodies: Sequence[RunBody], touched: RunContact, device: wp.Device) -> None:
    """Set ``integrator`` of a body's options to implicit steps if explicit ones would be slower than real time and
    much slower than these, or unstable with the step that users give; a note of the body says so.

    The choice is made for one body of the corotated law on a forest, which touches neither itself nor other bodies.
    """
    if not may_choose(bodies):
        return
    body = bodies[0]
    model, mesh = body.model, body.soft.mesh
    if not (isinstance(model, Corotated) and model.level is None and isinstance(mesh, TetForest)):
        return
    explicit, implicit = ON_CUDA if device.is_cuda else ON_CPU
    size = len(mesh.tets), touched.contact is not None
    step = _stable_step(body)
    if step < SHORTEST:
        return
    slow = SHORTER * step / explicit.of(*size)
    fast = (args.dt or IMPLICIT_DT) / implicit.of(*size)
    if args.dt is not None and args.dt > FASTER * step:
        why = f"unstable from about {1e3 * step:.2g} ms on"
    elif args.dt is None and slow < 1.0 and fast >= FASTER * slow:
        why = f"about {fast / slow:.1g} times as slow"
    else:
        return
    args.integrator = "backward-euler"
    body.subject.notes.append(
        f"implicit steps, which damp vibrations, since explicit ones would be {why} "
        "(--integrator symplectic-euler makes those)"
    )


def may_choose(bodies: Sequence[RunBody]) -> bool:
    """Whether the options leave the choice open."""
    args = bodies[0].args
    is_short = args.dt is not None and args.dt <= LONG
    given = args.integrator or is_short or args.viscosity or is_static(args) or are_several()
    return not (given or args.self_contact or len(bodies) > 1 or bodies[0].remesh is not None)


def _stable_step(body: RunBody) -> float:
    """An estimate of the largest stable step at rest [s]: the smallest height of an element over the speed of sound. It
    was within 10 % for four uniform organs and a box, and is within 25 % where stiffness jumps."""
    mesh, material = body.soft.mesh, body.soft.discretization
    x = mesh.points[mesh.tets].astype(float)
    faces = np.array([(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)])
    a, b, c = np.moveaxis(x[:, faces], 2, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=2)
    volumes = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / 6.0
    heights = 3.0 * volumes / areas.max(axis=1)
    stiffness = material.lam.numpy().astype(float) + 2.0 * material.mu.numpy()
    return float((heights * np.sqrt(np.asarray(body.soft.material.density, dtype=float) / stiffness)).min())
