"""What the tissue of a page is, and others: laws, moduli, and tissues of the literature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from warp_corot.elasticity import MODELS, Corotated, EdgeStVK, MassSpring, Model, Prestressed, Prony
from warp_corot.elasticity.dilatation import AUTO
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.simulation.simulation import Simulation

#: Weight over stiffness, density g L / E, from which on a body of length L hardly keeps its shape.
COLLAPSING = 0.15
#: The name of the choice that gives every element its own rotation.
OWN = "own"


class Tissue(NamedTuple):
    """A tissue that a visitor may choose.

    Attributes:
        name: Its name.
        young: Young's modulus [Pa].
        density: [kg/m^3], of Mech. Mater. 44 (2012) 174, table 3.
        source: The source of Young's modulus.
        poisson: Poisson's ratio; all are nearly incompressible, and a larger one takes longer.
    """

    name: str
    young: float
    density: float
    source: str
    poisson: float = 0.45


_ARDA = "Arda et al., AJR 197 (2011) 532: shear waves"
TISSUES = (
    Tissue("brain", 1.9e3, 1040.0, "Budday et al., J. Mech. Behav. Biomed. 46 (2015) 318: white matter, indented"),
    Tissue("fat", 3.25e3, 950.0, "Samani et al., Phys. Med. Biol. 52 (2007) 1565: of the breast, indented"),
    Tissue("kidney", 5.0e3, 1050.0, f"{_ARDA} in the cortex"),
    Tissue("liver", 5.5e3, 1060.0, "Roulot et al., J. Hepatol. 48 (2008) 606: transient elastography, 429 people"),
    Tissue("muscle", 11.1e3, 1050.0, f"{_ARDA} in the gastrocnemius"),
)


def present(sim: Simulation) -> dict[str, Any]:
    """The present tissue of the first body, by the names of ``switched``."""
    material, model = sim.bodies[0].material, sim.models[0]
    mean = material.isotropic
    return {
        "law": next(name for name, kind in MODELS.items() if type(model) is kind),
        "rotations": OWN if (level := getattr(model, "rotation_level", None)) is None else str(level),
        "young": float(np.mean(mean.young)),
        "poisson": float(np.mean(mean.poisson)),
        "density": float(np.mean(material.density)),
        "remesh": bool(sim.remeshing.every),
        "weight": any(sim.gravity),
    }


def choices(sim: Simulation) -> dict[str, Any]:
    """The laws and rotations that can be chosen, and whether Poisson's ratio and remeshing can be."""
    meshes = [body.mesh for body in sim.bodies]
    levels = [int(mesh.levels.max()) for mesh in meshes if isinstance(mesh, TetForest)]
    are_forests = len(levels) == len(meshes)
    now, names = present(sim), [OWN]
    if are_forests:
        names += ["auto", *map(str, range(min(levels)))]
    return {
        "laws": [name for name in MODELS if name == now["law"] or name not in ("prestressed", "prony")],
        "rotations": list(dict.fromkeys([*names, now["rotations"]])),
        "poisson": all(type(body.material) is Isotropic for body in sim.bodies),
        "remesh": sim.worlds == 1 and are_forests,
    }


def switched(sim: Simulation, wanted: dict[str, Any], gravity: Sequence[float]) -> dict[str, Any]:
    """The models, materials and gravity of ``remade`` for a wanted tissue; what stays as it is is left out.

    Args:
        wanted: Values by the names of ``present``.
        gravity: Gravity of bodies with weight [m/s^2], [3].
    """
    now, found = present(sim), dict[str, Any]()
    changes = {name for name, value in now.items() if wanted.get(name, value) != value}
    if changes & {"law", "rotations"}:
        model = model_of(wanted["law"], wanted["rotations"], sim.models[0])
        found["models"] = [model] * len(sim.bodies)
    if "weight" in changes:
        found["gravity"] = gravity if wanted["weight"] else (0.0, 0.0, 0.0)
    if changes & {"young", "poisson", "density"}:
        poisson = wanted["poisson"] if "poisson" in changes else None
        stiffer, heavier = wanted["young"] / now["young"], wanted["density"] / now["density"]
        found["materials"] = [changed(body.material, stiffer, poisson, heavier) for body in sim.bodies]
    return found


def collapses(tissue: dict[str, Any], gravity: Sequence[float], size: float) -> bool:
    """Whether bodies of a size [m] would hardly keep their shape under gravity [m/s^2]."""
    weight = tissue["density"] * float(np.linalg.norm(gravity)) * size if tissue["weight"] else 0.0
    return weight > COLLAPSING * tissue["young"]


def model_of(law: str, rotations: str, former: Model | None = None) -> Model:
    """The model that the controls name; only the corotated one shares rotations, and springs share no dilatation.

    Args:
        former: The present model, whose choice of dilatation is kept.
    """
    kind = MODELS[law]
    if kind in (Prestressed, Prony) and former is not None:
        return former
    options: dict[str, Any] = {}
    springs = (EdgeStVK, MassSpring)
    if kind not in springs and not isinstance(former, springs):
        options["dilatation"] = getattr(former, "dilatation", AUTO)
    if kind is Corotated and rotations != OWN:
        options["rotation_level"] = _number(rotations)
    return kind(**options)


def changed(material: Any, stiffer: float, poisson: float | None, heavier: float = 1.0) -> Any:
    """The material with its stiffness and its density times factors and, if it is isotropic and one is given, another
    Poisson's ratio.
    """
    stiff = [name for name in vars(material) if name.startswith(("young", "shear", "k1"))]
    values = {name: getattr(material, name) * stiffer for name in stiff}
    values["density"] = material.density * heavier
    if poisson is not None and type(material) is Isotropic:
        values["poisson"] = poisson
    return replace(material, **values)


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
