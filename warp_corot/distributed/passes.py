"""The passes of remeshing over the whole bodies, which every rank makes alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import ForceField, Model
from warp_corot.remesh.remeshing import Remeshing


class Passes(NamedTuple):
    """Passes over whole bodies; of a checkpoint, they go on from one process's simulation.

    Attributes:
        remeshing: The passes.
        fields: The force fields of the whole bodies.
    """

    remeshing: Remeshing
    fields: tuple[ForceField, ...]

    @classmethod
    def of(cls, bodies: Sequence[SoftBody], models: Sequence[Model], asked: Any, *, deterministic: bool) -> Passes:
        """The passes that a user asks for.

        Args:
            bodies, models, deterministic: The simulation's.
            asked: As for ``Remeshing``; or passes, which go on.

        Raises:
            InputError: As ``Remeshing``.
        """
        if isinstance(asked, Passes):
            return asked
        remeshing = Remeshing(bodies, models, asked, deterministic=deterministic)
        bound = zip(models, bodies, strict=True)
        fields = tuple(model.bind(body, deterministic=deterministic) for model, body in bound)
        remeshing.serve(fields)
        return cls(remeshing, fields)
