"""Soft bodies of USD stages and their materials, from the stage or by default."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.io.read.usd.scene import Scene, TetPrim
from warp_corot.materials.isotropic import Isotropic
from warp_corot.newton.library import newton

#: Young's modulus over the weight of a column as high as the body, if a stage gives no material.
STIFFNESS_PER_WEIGHT = 20.0
#: Fraction of critical damping of a body's slowest vibration, if no viscosity is given.
DAMPED_SHARE = 0.05
#: Stiffness of contact over Young's modulus times edge of a tetrahedron: it limits how deep bodies sink into the
#: ground.
CONTACT_STIFFNESS = 3.0
#: Defaults if a stage has no material and no option gives one; density in kg/m^3.
POISSON, DENSITY = 0.45, 1000.0
#: Newton's Young's modulus [Pa] and Poisson's ratio for a material without them.
FALLBACK = (1e6, 0.3)


@dataclass(frozen=True)
class StageOptions:
    """Values for what the stage does not define, in SI units.

    Attributes:
        young: Young's modulus if the stage gives none [Pa]; None: from the weight for bodies without a material, 1 MPa
            for materials without it.
        poisson: The same for Poisson's ratio; None: 0.45 for bodies without a material, 0.3 for materials without it.
        density: The same for density [kg/m^3]; None: 1000.
        gravity: Acceleration [m/s^2], in place of the stage's own.
        viscosity: Viscous stress over elastic shear stress of one strain [s]; None: the slowest vibration
            of each body has a twentieth of critical damping.
        ground: Height of a ground plane [m]; "auto": below everything, if nothing in the stage supports the bodies;
            "none".
        fix: Expression for the nodes that are held; see ``select_nodes``.
        radius: Contact radius around each point of a soft body [m].
        soft_contact: Whether soft bodies and cloth touch one another, and themselves.
    """

    young: float | None = None
    poisson: float | None = None
    density: float | None = None
    gravity: tuple[float, float, float] | None = None
    viscosity: float | None = None
    ground: float | str = "auto"
    fix: str | None = None
    radius: float = 0.0
    soft_contact: bool = True

    def __post_init__(self) -> None:
        young, poisson, density = self.young, self.poisson, self.density
        # The constructor checks the values.
        Isotropic(_first(young, 1.0), _first(poisson, POISSON), _first(density, DENSITY))
        if self.viscosity is not None and not (math.isfinite(self.viscosity) and self.viscosity >= 0):
            raise InputError(f"viscosity is {self.viscosity:g}; it must be zero or a positive time in seconds")
        if self.gravity is not None and not (np.shape(self.gravity) == (3,) and np.isfinite(self.gravity).all()):
            raise InputError(f"gravity is {self.gravity}; it must be three finite numbers [m/s^2]")
        if not (math.isfinite(self.radius) and self.radius >= 0):
            raise InputError(f"radius is {self.radius:g}; it must be zero or a positive length in metres")


@dataclass(eq=False)
class Body:
    """A soft body of a stage.

    Attributes:
        prim: Its prim.
        particles, tets: Its ranges in the model.
        young: Young's modulus [Pa], of its first tetrahedron.
        poisson: Poisson's ratio.
        density: Mean density [kg/m^3].
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
    """Give a body in a builder the material values that the stage lacks, and its viscosity.

    Args:
        body: The body; its values are set.
        builder: The builder; values that the stage lacks are NaN.
        scene: The stage.
        options: The substitutes.
        gravity: Acceleration [m/s^2].

    Returns:
        The chosen values in words, or None.

    Raises:
        InputError: A material that is not positive definite, or no mass.
    """
    units, path = scene.units, body.prim.path
    x = np.array(builder.particle_q[body.particles], dtype=np.float64)
    tets = np.array(builder.tet_indices[body.tets]).reshape(-1, 4) - body.particles.start
    volumes = 1.0 / (6.0 * np.abs(np.linalg.det(np.array(builder.tet_poses[body.tets]).reshape(-1, 3, 3))))
    body.edge = float((6.0 * math.sqrt(2.0) * volumes.mean()) ** (1 / 3)) * units.metres
    said, chosen = scene.says(path), []
    masses = np.array(builder.particle_mass[body.particles], dtype=np.float64)
    if "density" not in said:
        density = _first(options.density, DENSITY)
        # A body's masses exist already, with a default; those of other tetrahedra do not.
        masses = _lumped(tets, volumes, len(x)) if np.isnan(masses).any() else masses / (masses.sum() / volumes.sum())
        masses *= density / units.density
        builder.particle_mass[body.particles] = masses.tolist()
        chosen.append(("density", f"density {density:g} kg/m^3"))
    body.density = float(masses.sum() / volumes.sum()) * units.density
    if not body.density > 0.0:
        raise InputError(f"{scene.path}: {path}: has no mass; it must have a positive mass")
    size = np.ptp(x, axis=0) * units.metres
    lame = np.array(builder.tet_materials[body.tets], dtype=np.float64)
    body.given = not np.isnan(lame[:, :2]).any()
    if not {"young", "poisson"} <= said.keys():
        height = float(size["XYZ".index(scene.up_axis)])
        weight = float(f"{STIFFNESS_PER_WEIGHT * body.density * gravity * height:.1e}")
        young, poisson = FALLBACK if body.given else (weight, POISSON)
        young = said["young"] * units.pressure if "young" in said else _first(options.young, young)
        poisson = said["poisson"] if "poisson" in said else _first(options.poisson, poisson)
        lame[:, 0] = young / (2.0 * (1.0 + poisson)) / units.pressure
        lame[:, 1] = 2.0 * lame[:, 0] * poisson / (1.0 - 2.0 * poisson)
        taken = {"young": f"E = {young:g} Pa", "poisson": f"nu = {poisson:g}"}
        chosen[:0] = [(name, text) for name, text in taken.items() if name not in said]
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
    missing = "no physics material for a volume" if not body.given else "a physics material with missing values"
    return f"{path} has {missing}: {', '.join(text for _, text in chosen)} ({', '.join(f'--{n}' for n, _ in chosen)})"


def _lumped(tets: npt.NDArray[np.integer], volumes: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.float64]:
    """A quarter of each tetrahedron's volume at each of its corners, float64 [count]."""
    return np.bincount(tets.ravel(), np.repeat(volumes / 4.0, 4), minlength=count).astype(np.float64)


def _first(given: float | None, default: float) -> float:
    return default if given is None else given


def contact_law(soft: Sequence[Body]) -> tuple[float, float]:
    """Stiffness [N/m] of contact, and damping [N s/m] at half of critical, for the stiffest of the bodies."""
    body = max(soft, key=lambda one: one.young * one.edge)
    stiffness = CONTACT_STIFFNESS * body.young * body.edge
    return stiffness, math.sqrt(stiffness * body.density * body.edge**3)
