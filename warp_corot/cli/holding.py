"""The fixed nodes of a body: by ``--fix``, or chosen if it is not given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.holding.choice import supports_of
from warp_corot.materials.isotropic import Isotropic

if TYPE_CHECKING:
    from .input_mesh import InputMesh
    from .patches import BodyPatches


#: Factor on the stiffness that is needed at least.
MORE = 1.05


def up_of(subject: InputMesh, gravity: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The unit vector against gravity; the mesh's up axis without gravity."""
    if not gravity.any():
        return np.eye(3)["XYZ".index(subject.mesh.up_axis)]
    return -gravity / np.linalg.norm(gravity)


@dataclass(frozen=True, eq=False)
class FixedNodes:
    """The fixed nodes.

    Attributes:
        nodes: Mask bool [N].
        words: Text for the summary: "standing on its lowest 10 %", "free".
        lies: Whether the body needs a ground to lie on.
    """

    nodes: npt.NDArray[np.bool_]
    words: str
    lies: bool = False

    @property
    def count(self) -> int:
        return int(self.nodes.sum())


def held_as_told(subject: InputMesh, patches: BodyPatches, expressions: Sequence[str], pulled: bool) -> FixedNodes:
    """The nodes of ``--fix``, from all its patches.

    Args:
        subject: Gets a note if no node is fixed.
        patches: The body's patches.
        expressions: One or several expressions.
        pulled: Whether another option moves nodes.

    Raises:
        InputError: A bad expression, or no node is left free.
    """
    nodes = np.logical_or.reduce([patches.nodes(expression) for expression in expressions])
    said = " or ".join(expressions)
    if nodes.sum() == len(patches.used):
        raise InputError(f"expression {said!r}: holds all {nodes.sum()} nodes; at least one must be free to move")
    if not nodes.any():
        if not pulled:
            subject.notes.append(f"no node is held ({said!r}): the body falls freely")
        return FixedNodes(nodes, "free, nothing is held")
    return FixedNodes(nodes, f"held where {said}")


def held_by_default(
    subject: InputMesh, material: Isotropic, gravity: npt.NDArray[np.float64], *, may_stiffen: bool, may_lie: bool
) -> tuple[FixedNodes, float]:
    """The support of the body, and a factor on its stiffness: above one if no patch would support it with its present
    stiffness.

    Args:
        subject: Gets notes on the choice and its reasons.
        material: The body's material.
        gravity: Acceleration [m/s^2].
        may_stiffen: Whether Young's modulus was not given.
        may_lie: Whether the body may lie on a ground.
    """
    holds = supports_of(
        subject.mesh,
        young=material.young,
        density=material.density,
        gravity=gravity,
        surface=subject.surface,
        may_lie=may_lie,
    )
    if holds.lies:
        subject.notes.append(
            f"the body lies on a ground, since {holds.lies}, and nothing is fixed (--no-ground or --fix holds it)"
        )
        return FixedNodes(holds.nodes, "lying on a ground", lies=True), 1.0
    lines = holds.reasons()
    subject.notes += [*lines[:-1], f"{lines[-1]} (--fix chooses others)"]
    held = FixedNodes(holds.nodes, holds.words)
    if not (1.0 < holds.stiffer < np.inf):
        return held, 1.0
    if may_stiffen:
        subject.notes.append(
            f"it is {holds.stiffer:.2g} times as stiff as the default for its weight, so that this supports it"
        )
        return held, MORE * holds.stiffer
    sag = max(hold.sag for hold in holds.pieces)
    subject.notes.append(
        f"the body is so soft that it sags by about {sag:.0%} of its height; make it {holds.stiffer:.2g} times as "
        "stiff (--young), or fix more of it (--fix)"
    )
    return held, 1.0
