"""Meshes in Warp's wheel, each with a suitable scale and material."""

import importlib.util
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from warp_corot.errors import InputError


@dataclass(frozen=True)
class Asset:
    """A mesh with default values.

    Attributes:
        name: Short name, after ``warp:``.
        file: Path below Warp's package folder.
        scale: Factor on the file's coordinates.
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: Mass density [kg/m³].
        fix_below: Nodes below this height are fixed: the scaled rest coordinate along y [m].
        damping: Mass-proportional damping [1/s].
        duration: Simulated time [s] after which it is nearly at rest.
        note: Explanation of the values.
    """

    name: str
    file: str
    scale: float
    young: float
    poisson: float
    density: float
    fix_below: float
    damping: float
    duration: float
    note: str

    @property
    def path(self) -> Path:
        """The path of the file.

        Raises:
            InputError: Warp is not installed, or lacks its examples.
        """
        spec = importlib.util.find_spec("warp")
        folders = list(spec.submodule_search_locations or ()) if spec else []
        for folder in folders:
            candidate = Path(folder) / self.file
            if candidate.is_file():
                return candidate
        raise InputError(f"warp:{self.name}: {self.file} is not in the installed Warp package")


ASSETS: dict[str, Asset] = {
    asset.name: asset
    for asset in [
        Asset(
            name="bunny",
            file="examples/assets/bunny.usd",
            scale=0.1,
            young=3.0e4,
            poisson=0.45,
            density=1000.0,
            fix_below=0.01,
            damping=2.0,
            duration=4.0,
            note="the Stanford bunny, 16 cm long, of silicone gel",
        ),
        Asset(
            name="bear",
            file="examples/assets/bear.usd",
            scale=0.1,
            young=1.0e5,
            poisson=0.45,
            density=1000.0,
            fix_below=0.01,
            damping=2.0,
            duration=5.0,
            note="a toy bear of 55 cm of soft silicone rubber: its back sags by 9 % of its height, its nose by 14 %, "
            "after some seconds of swaying",
        ),
    ]
}


def find_asset(name: str | PathLike[str]) -> Asset | None:
    """The asset with the name ``warp:NAME``, or None for a name without ``warp:``.

    Raises:
        InputError: There is no such asset.
    """
    prefix, colon, rest = str(name).partition(":")
    if prefix != "warp" or not colon:
        return None
    if rest not in ASSETS:
        known = ", ".join(f"warp:{known}" for known in ASSETS)
        raise InputError(f"warp:{rest}: no such asset; it must be {known}")
    return ASSETS[rest]
