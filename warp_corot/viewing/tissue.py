"""Controls that continue the motion with another law, material or remeshing."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.elasticity import MODELS, Corotated, EdgeStVK, MassSpring, Model, Prestressed, Prony
from warp_corot.elasticity.dilatation import AUTO
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest
from warp_corot.remesh.online import OnlineRemesh

if TYPE_CHECKING:
    from viser import ViserServer

    from .session import Session

#: The name of the choice that gives every element its own rotation.
OWN = "own"


class Tissue:
    """The folder of these controls. A button applies all choices at once.

    Args:
        server: viser's server.
        session: The session of the page.
    """

    def __init__(self, server: ViserServer, session: Session):
        self._session, gui, sim = session, server.gui, session.sim
        meshes = [body.mesh for body in sim.bodies]
        material = sim.bodies[0].material
        with gui.add_folder("tissue", expand_by_default=False):
            law = next(name for name, kind in MODELS.items() if type(sim.models[0]) is kind)
            self._law = gui.add_dropdown(
                "law",
                [name for name in MODELS if name == law or name not in ("prestressed", "prony")],
                initial_value=law,
            )
            self._rotations = gui.add_dropdown(
                "rotations", _levels(meshes, sim.models[0]), initial_value=_level_of(sim.models[0]), hint="corotated"
            )
            self._stiffness = gui.add_slider("stiffness ×", 0.1, 5.0, 0.1, 1.0, hint="over what it was at first")
            self._poisson = gui.add_slider(
                "Poisson's ratio", 0.0, 0.49, 0.01, _mean_poisson(material), disabled=type(material) is not Isotropic
            )
            self._remeshing = gui.add_checkbox(
                "remeshing",
                bool(sim.remeshing.every),
                disabled=sim.worlds > 1 or not all(isinstance(mesh, TetForest) for mesh in meshes),
            )
            button = gui.add_button("switch", hint="hands let go, motion goes on")
        self._options = OnlineRemesh()
        self._then = self._values()
        button.on_click(lambda _: session.ask(self._switch))

    def _values(self) -> tuple[Any, ...]:
        return self._law.value, self._rotations.value, self._stiffness.value, self._poisson.value

    def _switch(self) -> None:
        """Called on the session's thread."""
        sim, now = self._session.sim, self._values()
        law, rotations, stiffness, poisson = self._then
        models = None
        if now[:2] != (law, rotations):
            models = [model_of(now[0], now[1], sim.models[0])] * len(sim.bodies)
        own = now[3] if now[3] != poisson else None
        materials = [changed(body.material, now[2] / stiffness, own) for body in sim.bodies]
        former = [None if each is None else each.options for each in sim.remeshing.changing]
        remesh = [(each or self._options) if self._remeshing.value else None for each in former]
        self._session.switch(models=models, materials=materials, remesh=remesh)
        self._then = now


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


def changed(material: Any, scale: float, poisson: float | None) -> Any:
    """The material with its stiffness times a factor and, if it is isotropic and one is given, another Poisson's
    ratio.
    """
    stiff = [name for name in vars(material) if name.startswith(("young", "shear", "k1"))]
    values = {name: getattr(material, name) * scale for name in stiff}
    if poisson is not None and type(material) is Isotropic:
        values["poisson"] = poisson
    return replace(material, **values)


def _levels(meshes: list[Any], model: Model) -> list[str]:
    names = [OWN]
    if all(isinstance(mesh, TetForest) for mesh in meshes):
        names += ["auto", *(str(level) for level in range(min(int(mesh.levels.max()) for mesh in meshes)))]
    return list(dict.fromkeys([*names, _level_of(model)]))


def _level_of(model: Model) -> str:
    level = getattr(model, "rotation_level", None)
    return OWN if level is None else str(level)


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _mean_poisson(material: Any) -> float:
    return float(np.clip(np.round(np.mean(material.isotropic.poisson), 2), 0.0, 0.49))
