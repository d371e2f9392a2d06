"""The description of a simulation in the custom data of its stage's layer."""

from __future__ import annotations

from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

#: Key in the layer's custom data.
KEY = "warp_corot"


def provenance(sim: Simulation, held: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Program, models, integrator, units, device and held nodes.

    Args:
        sim: The simulation.
        held: Which nodes of the drawn body are held.
    """
    models = {}
    for number, model in enumerate(sim.models, start=1):
        options = ", ".join(f"{name}={value!r}" for name, value in vars(model).items() if value is not None)
        models[f"body{number}"] = f"{type(model).__name__}({options})"
    integrator = {name: value for name, value in asdict(sim.integrator).items() if value is not None}  # type: ignore
    return {
        "program": f"warp_corot {_version()}, warp {wp.__version__}",
        "units": "metres, kilograms, seconds, pascals",
        "device": f"{sim.device} ({sim.device.name})",
        "models": models,
        "integrator": {"name": type(sim.integrator).__name__, **integrator},
        "gravity": " ".join(f"{g:.9g}" for g in sim.gravity),
        "heldNodes": int(np.count_nonzero(held)),
    }


def steps_made(sim: Simulation) -> dict[str, Any]:
    """The number of steps, and their lengths [s]."""
    shortest, longest = sim.dt_range
    return {"steps": sim.total_steps, "shortestStep": float(shortest), "longestStep": float(longest)}


def _version() -> str:
    try:
        return version("warp-corot")
    except PackageNotFoundError:
        return "(not installed)"
