"""Soft bodies that hang and stand under their own weight, made with defaults."""

from dataclasses import dataclass
from functools import cache

import numpy as np

import warp_corot as wc
from warp_corot.io.read.meshes import load_tets

DENSITY = 1000.0
GRAVITY = 9.81

LAWS = {
    "corotated": wc.Corotated,
    "leaf by leaf": lambda: wc.Corotated(subtrees=False),
    "linear": wc.Linear,
    "stvk": wc.StVenantKirchhoff,
    "neo-hookean": wc.NeoHookean,
    "edge-stvk": wc.EdgeStVK,
    "mass-spring": wc.MassSpring,
    "fibres": wc.Corotated,
}

# --- shapes: a mesh of about so many elements, and the axis along which its lowest tenth is held ----------------------


def _adaptive(domain, count):
    """A mesh made like the command line's meshes of organs."""
    size = float(np.ptp(domain.bounds, axis=0).max()) * 1.001 / max(1, round((count / 30) ** (1 / 3)))
    return wc.TetForest.from_domain(domain, size, max_level=7, target_elements=count, device="cpu")


def _capsule(count):
    """A capsule 112 mm long, of radius 15 mm, leaning by 25 degrees."""
    along = 0.082 * np.array([np.sin(np.radians(25)), np.cos(np.radians(25)), 0.0])
    return _adaptive(wc.Domain.capsule((0.0, 0.0, 0.0), along, 0.015, device="cpu"), count)


def _plate(count):
    """A plate of 60 x 5 x 60 mm, one cube thick."""
    return wc.TetForest.box((12, 1, 12), 0.005, level=int(np.log2(count / (6 * 144))))


def _bear(_):
    bear = load_tets("warp:bear", scale=0.1)
    return wc.TetMesh(bear.points, bear.cells, up_axis=bear.up_axis)


SHAPES = {
    "sphere": (lambda count: _adaptive(wc.Domain.sphere(0.05, device="cpu"), count), 1),
    "capsule": (_capsule, 1),
    "torus": (lambda count: _adaptive(wc.Domain.torus(0.04, 0.015, axis="X", device="cpu"), count), 1),
    "bunny": (lambda count: _adaptive(wc.Domain.from_surface("warp:bunny", device="cpu"), count), 1),
    "bear": (_bear, 1),
    "plate": (_plate, 2),
    "core": (lambda count: _adaptive(wc.Domain.sphere(0.05, device="cpu"), count), 1),
}


@cache
def _mesh(shape, count, general):
    mesh = SHAPES[shape][0](count)
    return wc.TetMesh(mesh.points, mesh.tets, up_axis=mesh.up_axis) if general else mesh


# --- bodies -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Loaded:
    """A body with the lowest tenth of its height fixed (for a plate one edge), released from rest under gravity.

    Attributes:
        shape, law: Names in SHAPES and LAWS.
        kilopascals: Young's modulus [kPa].
        general: Whether the elements are a general mesh.
        damping: Rate of mass-proportional damping [1/s].
        poisson: Poisson's ratio.
    """

    shape: str
    kilopascals: float
    law: str
    general: bool = False
    damping: float = 0.0
    poisson: float = 0.45

    def __str__(self):
        mesh = "general" if self.general or self.shape == "bear" else "forest"
        damped = f"-{self.damping:g}/s" if self.damping else ""
        return f"{self.shape}-{self.kilopascals:g}kPa-{self.law.replace(' ', '-')}-{mesh}{damped}"

    def simulation(self, count, device="cpu", dt=None):
        mesh = _mesh(self.shape, count, self.general)
        body = wc.SoftBody(mesh, self.material, device=device)
        heights = mesh.points[:, SHAPES[self.shape][1]]
        body.fix(heights < heights.min() + 0.1 * np.ptp(heights))
        return wc.Simulation(body, model=LAWS[self.law](), integrator=wc.SymplecticEuler(dt, self.damping))

    @property
    def material(self):
        young = 1e3 * self.kilopascals
        if self.law == "fibres":
            up = (0.0, 1.0, 0.0)
            return wc.TransverselyIsotropic(3 * young, young, 0.4, 0.45, young / 3, direction=up, density=DENSITY)
        if self.shape == "core":
            # A core of half the radius, a hundred times as stiff as the flesh around it.
            return wc.Isotropic(
                lambda x: young * np.where(np.linalg.norm(x, axis=1) < 0.025, 100.0, 1.0), self.poisson, DENSITY
            )
        return wc.Isotropic(young, self.poisson, DENSITY)


# --- thirty bodies ----------------------------------------------------------------------------------------------------

#: Approximate number of elements, and duration of the motion [s].
MANY, LONG = 5000, 2.0
FEW, SHORT = 1500, 0.5

#: All shapes at 1, 3, 5, 10 and 30 kPa. StVK only under light compression: its energy has no barrier.
THIRTY = [
    Loaded("sphere", 1, "corotated"),
    Loaded("sphere", 3, "neo-hookean"),
    Loaded("sphere", 5, "corotated", general=True),
    Loaded("sphere", 10, "mass-spring"),
    Loaded("sphere", 30, "stvk"),
    Loaded("capsule", 1, "neo-hookean"),
    Loaded("capsule", 3, "fibres"),
    Loaded("capsule", 5, "corotated"),
    Loaded("capsule", 5, "neo-hookean", general=True),
    Loaded("capsule", 10, "corotated", poisson=0.49),
    Loaded("capsule", 30, "leaf by leaf"),
    Loaded("torus", 1, "linear"),
    Loaded("torus", 3, "corotated", general=True),
    Loaded("torus", 5, "neo-hookean", damping=2.0),
    Loaded("torus", 10, "corotated"),
    Loaded("torus", 30, "stvk"),
    Loaded("bunny", 1, "corotated", damping=2.0),
    Loaded("bunny", 3, "corotated", damping=2.0),
    Loaded("bunny", 3, "neo-hookean"),
    Loaded("bunny", 5, "linear"),
    Loaded("bunny", 10, "neo-hookean", general=True),
    Loaded("bunny", 30, "fibres", general=True),
    Loaded("bear", 1, "corotated"),
    Loaded("bear", 3, "neo-hookean"),
    Loaded("bear", 5, "corotated", damping=2.0),
    Loaded("bear", 10, "linear"),
    Loaded("bear", 30, "fibres"),
    Loaded("plate", 1, "neo-hookean"),
    Loaded("plate", 3, "corotated"),
    Loaded("plate", 5, "stvk"),
    Loaded("plate", 10, "neo-hookean", general=True),
    Loaded("plate", 30, "edge-stvk"),
    Loaded("core", 1, "neo-hookean"),
    Loaded("core", 3, "corotated"),
    Loaded("core", 5, "corotated", general=True),
    Loaded("core", 10, "mass-spring"),
    Loaded("core", 30, "neo-hookean", damping=2.0),
]

#: The shapes and laws again, for which trouble comes early.
DOZEN = [
    Loaded("sphere", 1, "corotated"),
    Loaded("sphere", 1, "neo-hookean", general=True),
    Loaded("capsule", 1, "corotated", general=True),
    Loaded("capsule", 3, "neo-hookean"),
    Loaded("torus", 1, "corotated", damping=2.0),
    Loaded("torus", 3, "neo-hookean"),
    Loaded("bunny", 1, "corotated"),
    Loaded("bunny", 3, "neo-hookean"),
    Loaded("bear", 3, "neo-hookean"),
    Loaded("bear", 1, "fibres"),
    Loaded("plate", 5, "stvk"),
    Loaded("core", 3, "corotated"),
]
