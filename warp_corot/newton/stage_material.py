"""Soft bodies of USD stages and what they are made of, where the stage says it and where it does not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..io.usd_scene import Scene, TetPrim
from ..materials import Isotropic
from .library import newton

#: Young's modulus over the weight of a column as high as the body, where a stage gives no material.
STIFFNESS_PER_WEIGHT = 20.0
#: Share of critical damping of a body's slowest vibration, where no viscosity is given.
DAMPED_SHARE = 0.05
#: Stiffness of contact over that of a tetrahedron, Young's modulus times edge: how deep bodies sink into the ground.
CONTACT_STIFFNESS = 3.0


@dataclass(frozen=True)
class StageOptions:
    """What the stage does not say, in SI units.

    Attributes:
        young: Young's modulus of bodies without a material [Pa]; None: by their weight.
        poisson, density: The same for Poisson's ratio and density [kg/m^3].
        gravity: [m/s^2], in place of the stage's own.
        viscosity: Viscous stress over elastic shear stress of one strain [s]; None: so much that the slowest vibration
            of each body is damped by a twentieth of critical damping.
        ground: Height of a ground plane [m]; "auto": under everything, if the stage has nothing to stand on or to hang
            from; "none".
        fix: Expression for the nodes that are held; see ``select_nodes``.
    """

    young: float | None = None
    poisson: float = 0.45
    density: float = 1000.0
    gravity: tuple[float, float, float] | None = None
    viscosity: float | None = None
    ground: float | str = "auto"
    fix: str | None = None


@dataclass(eq=False)
class Body:
    """A soft body of a stage.

    Attributes:
        prim: Where it comes from.
        particles, tets: Its ranges in the model.
        young: Young's modulus [Pa], of its first tetrahedron.
        poisson: Poisson's ratio.
        density: [kg/m^3], mean.
        edge: Mean edge of its tetrahedra [m].
        given: Whether the stage gives the material.
    """

    prim: TetPrim
    particles: slice
    tets: slice
    young: float = math.nan
    poisson: float = math.nan
    density: float = math.nan
    edge: float = math.nan
    given: bool = True


def give_material(
    body: Body, builder: newton.ModelBuilder, scene: Scene, options: StageOptions, gravity: float
) -> str | None:
    """Give a body in a builder what the stage does not say of its material, and its viscosity.

    Args:
        body: Gets its values.
        builder: What is not given is NaN in it.
        scene: The stage.
        options: What is taken instead.
        gravity: [m/s^2].

    Returns:
        What was chosen, in words, or None.

    Raises:
        InputError: A material that is not positive definite, or no mass.
    """
    units, path = scene.units, body.prim.path
    x = np.array(builder.particle_q[body.particles], dtype=np.float64)
    tets = np.array(builder.tet_indices[body.tets]).reshape(-1, 4) - body.particles.start
    volumes = np.abs(np.linalg.det(x[tets[:, 1:]] - x[tets[:, :1]])) / 6.0
    body.edge = float((6.0 * math.sqrt(2.0) * volumes.mean()) ** (1 / 3)) * units.metres
    masses = np.array(builder.particle_mass[body.particles], dtype=np.float64)
    chosen = []
    if np.isnan(masses).any():
        share = options.density / units.density * volumes / 4.0
        masses = np.bincount(tets.ravel(), np.repeat(share, 4), minlength=len(x)).astype(np.float64)
        builder.particle_mass[body.particles] = masses.tolist()
        chosen.append(f"density {options.density:g} kg/m^3")
    body.density = float(masses.sum() / volumes.sum()) * units.density
    if not body.density > 0.0:
        raise InputError(f"{scene.path}: {path}: has no mass")
    size = np.ptp(x, axis=0) * units.metres
    lame = np.array(builder.tet_materials[body.tets], dtype=np.float64)
    if np.isnan(lame[:, :2]).any():
        young = options.young
        if young is None:
            height = float(size["XYZ".index(scene.up_axis)])
            young = float(f"{STIFFNESS_PER_WEIGHT * body.density * gravity * height:.1e}")
        material = Isotropic(young, options.poisson, body.density)
        lame[:, :2] = [float(material.mu) / units.pressure, float(material.lam) / units.pressure]
        chosen.insert(0, f"E = {young:g} Pa, nu = {options.poisson:g}")
        body.given = False
    mu, lam = lame[:, 0] * units.pressure, lame[:, 1] * units.pressure
    if not (np.isfinite(lame[:, :2]).all() and (mu > 0.0).all() and (3.0 * lam + 2.0 * mu > 0.0).all()):
        raise InputError(
            f"{scene.path}: {path}: its material is not positive definite, with Lame's parameters mu = "
            f"{mu[0]:g} Pa and lambda = {lam[0]:g} Pa; Young's modulus must be positive, Poisson's ratio in (-1, 0.5)"
        )
    body.young = float(mu[0] * (3 * lam[0] + 2 * mu[0]) / (lam[0] + mu[0]))
    body.poisson = float(lam[0] / (2 * (lam[0] + mu[0])))
    relaxation = options.viscosity
    if relaxation is None:
        slowest = 0.5 * math.pi * math.sqrt(body.young / body.density) / float(size.max())
        relaxation = 2.0 * DAMPED_SHARE / slowest
    lame[:, 2] = 2.0 * lame[:, 0] * relaxation
    builder.tet_materials[body.tets] = [tuple(row) for row in lame.tolist()]
    if not chosen:
        return None
    return f"{path} has no physics material for a volume: {', '.join(chosen)} (--young, --poisson, --density)"


def contact_law(soft: Sequence[Body]) -> tuple[float, float]:
    """Stiffness [N/m] of contact, and damping [N s/m] at half of critical, for the stiffest of the bodies."""
    body = max(soft, key=lambda one: one.young * one.edge)
    stiffness = CONTACT_STIFFNESS * body.young * body.edge
    return stiffness, math.sqrt(stiffness * body.density * body.edge**3)
