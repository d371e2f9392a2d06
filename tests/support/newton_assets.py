"""Replacements for the downloads of Newton's example with a Franka arm: an arm of boxes with its measures, a soft
block."""

from math import pi
from pathlib import Path

import numpy as np
from newton_scenes import add_grid, builder
from pxr import Usd, UsdGeom, Vt

#: Origins [m], rolls and limits [rad] of the arm's joints, from its Denavit-Hartenberg parameters.
JOINTS = (
    ("0 0 0.333", 0.0, (-2.74, 2.74)),
    ("0 0 0", -pi / 2, (-1.78, 1.78)),
    ("0 -0.316 0", pi / 2, (-2.9, 2.9)),
    ("0.0825 0 0", pi / 2, (-3.04, -0.15)),
    ("-0.0825 0.384 0", -pi / 2, (-2.8, 2.8)),
    ("0 0 0", pi / 2, (0.54, 4.5)),
    ("0.088 0 0", pi / 2, (-3.0, 3.0)),
)
#: Edge of the block's cells, of which it has two in each direction [m].
CELL = 0.018


def _link(name: str, mass: float = 1.0, collision: str = "") -> str:
    inertia = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
    return f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial>{collision}</link>'


def _joint(kind: str, parent: str, child: str, origin: str, turn: str = "0 0 0", more: str = "") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{origin}" rpy="{turn}"/>'
    return f'<joint name="{child}_joint" type="{kind}">{ends}{more}</joint>'


def _range(low: float, high: float, axis: str = "0 0 1") -> str:
    return f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="100" velocity="2"/>'


def arm() -> str:
    """An arm of seven joints with a hand of two fingers, in URDF."""
    parts = [_link("link0")]
    for k, (origin, roll, limits) in enumerate(JOINTS):
        parts += [_link(f"link{k + 1}")]
        parts += [_joint("revolute", f"link{k}", f"link{k + 1}", origin, f"{roll} 0 0", _range(*limits))]
    parts += [_link("hand"), _joint("fixed", "link7", "hand", "0 0 0.107", f"0 0 {-pi / 4}")]
    for name, side in (("left", 1), ("right", -1)):
        pad = f'<origin xyz="0 {side * 0.005} 0.03"/><geometry><box size="0.02 0.01 0.05"/></geometry>'
        parts += [_link(f"{name}_finger", 0.05, f"<collision>{pad}</collision>")]
        moves = _range(0.0, 0.04, f"0 {side} 0")
        parts += [_joint("prismatic", "hand", f"{name}_finger", "0 0 0.0584", more=moves)]
    return f'<?xml version="1.0"?><robot name="arm">{"".join(parts)}</robot>'


def write_block(path: Path) -> None:
    """Write a cube about the origin as a TetMesh."""
    made = builder()
    add_grid(made, dims=(2, 2, 2), cell=CELL, pos=(-CELL, -CELL, -CELL))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.TetMesh.Define(stage, "/root/Model/TetMesh")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.array(made.particle_q, np.float32)))
    mesh.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.array(made.tet_indices, np.int32).reshape(-1, 4)))
    stage.Save()


def stand_in(folder: Path, name: str) -> Path:
    """A folder with the content of the download of this name."""
    place = folder / name
    if name == "franka_emika_panda":
        (place / "urdf").mkdir(parents=True)
        (place / "urdf" / "fr3_franka_hand.urdf").write_text(arm())
    else:
        place.mkdir(parents=True)
        write_block(place / "model.usda")
    return place
