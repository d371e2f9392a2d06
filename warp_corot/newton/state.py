"""The solver's data in Newton's models and states: custom attributes in the namespace ``warp_corot``."""

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
    """The name of a forest in builders and models, with a reference to the forest.

    Newton keeps text unchanged; a model that was written to a file and read again has a plain ``str``.
    """

    forest: TetForest

    @classmethod
    def of(cls, forest: TetForest) -> ForestName:
        name = cls(f"forest of {len(forest.tets)} tetrahedra")
        name.forest = forest
        return name


def register_custom_attributes(builder: newton.ModelBuilder) -> None:
    """Let states carry results for each tetrahedron, as ``state.warp_corot``; call it before ``finalize``.

    ``rotation``: wp.quat [T], from rest to world. ``stress``: wp.mat33 [T], Cauchy stress in world axes [Pa].
    ``von_mises``: wp.float32 [T] [Pa]. All belong to the positions in the same state. They cost about one force
    evaluation a step. ``State.assign`` copies them. Newton 1.8's ``ViewerFile`` does not record namespaces, and could
    not load a model whose state attributes have none; ``SolverCorotated.write_attributes`` computes them again.
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
    """Add attributes to the model for the forest and the fill of each tetrahedron."""
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
    """An attribute in a model's or a state's namespace, or None."""
    return getattr(getattr(owner, NAMESPACE, None), name, None)
