"""What the solver keeps in Newton's models and states: custom attributes of the namespace ``warp_corot``."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_corot.mesh import TetForest

from .library import newton

NAMESPACE = "warp_corot"

FOREST = f"{NAMESPACE}:forest"

#: Attributes of every tetrahedron in a state, with their types.
STATE = {"rotation": wp.quat, "stress": wp.mat33, "von_mises": wp.float32}


class ForestName(str):
    """The name of a forest in builders and models, which has the forest with it for as long as they last.

    Newton keeps text as it is given; whatever writes it to a file and reads it again has a plain ``str``.
    """

    forest: TetForest

    @classmethod
    def of(cls, forest: TetForest) -> ForestName:
        name = cls(f"forest of {len(forest.tets)} tetrahedra")
        name.forest = forest
        return name


def register_custom_attributes(builder: newton.ModelBuilder) -> None:
    """Have states carry what the solver finds in each tetrahedron, as ``state.warp_corot``: before ``finalize``.

    ``rotation``: wp.quat [T], from rest to world. ``stress``: wp.mat33 [T], Cauchy stress in world axes [Pa].
    ``von_mises``: wp.float32 [T] [Pa]. All are those of the positions in the same state. They cost about one force
    evaluation a step. ``State.assign`` takes them along. Newton 1.8's ``ViewerFile`` records no namespaces, and could
    not load a model that has attributes of states without: ``SolverCorotated.write_attributes`` finds them again.
    """
    for name, dtype in STATE.items():
        builder.add_custom_attribute(
            newton.ModelBuilder.CustomAttribute(
                name=name,
                dtype=dtype,
                frequency=newton.Model.AttributeFrequency.TETRAHEDRON,
                assignment=newton.Model.AttributeAssignment.STATE,
                namespace=NAMESPACE,
            )
        )


def register_forests(builder: newton.ModelBuilder) -> None:
    """Room in the model for which tetrahedra are which forest's, and how full they are."""
    if f"{NAMESPACE}:forest" in builder.custom_attributes:
        return
    attribute = newton.ModelBuilder.CustomAttribute
    builder.add_custom_frequency(newton.ModelBuilder.CustomFrequency(name="forest", namespace=NAMESPACE))
    builder.add_custom_attribute(attribute(name="forest", dtype=str, frequency=FOREST, default="", namespace=NAMESPACE))
    for name, references in (("forest_particle", "particle"), ("forest_tet", "tetrahedron")):
        builder.add_custom_attribute(
            attribute(name=name, dtype=wp.int32, frequency=FOREST, references=references, namespace=NAMESPACE)
        )
    builder.add_custom_attribute(
        attribute(
            name="fill",
            dtype=wp.float32,
            frequency=newton.Model.AttributeFrequency.TETRAHEDRON,
            default=1.0,
            namespace=NAMESPACE,
        )
    )


def attribute_of(owner: Any, name: str) -> Any:
    """An attribute of a model's or a state's namespace, if it is there."""
    return getattr(getattr(owner, NAMESPACE, None), name, None)
