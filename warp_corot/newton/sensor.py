"""A sensor of the forces of soft contacts on shapes and bodies."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.newton.rows import sum_soft_contacts

from .library import SolverBase, newton


class SensorSoftContact:
    """Measures the forces of soft bodies on chosen shapes or bodies, as ``newton.sensors.SensorContact`` does for rigid
    contacts.

    Example::

        sensor = warp_corot.newton.SensorSoftContact(model, sensing_bodies="finger*")
        observables = solver.observables(sensor.solver_observable_kinds, contacts=contacts)
        solver.step(state_in, state_out, control, contacts, dt, observables=observables)
        sensor.update(state_out, contacts, observables=observables)
        force = sensor.total_force.numpy()

    Args:
        model: The model.
        sensing_bodies: Bodies: a pattern of their labels as in a file name, several, or indices.
        sensing_shapes: Shapes, in place of bodies.

    Attributes:
        sensing_indices: Indices of bodies or shapes, in the order of the results.
        total_force: Force on each [N], the mean over the last step, vec3 [n].
        total_force_friction: Its part across the normals of the contacts [N], vec3 [n].

    Raises:
        InputError: Both or none are given, nothing has these labels, or an index is out of range.
    """

    solver_observable_kinds = frozenset({SolverBase.ObservableKind.CONTACT_F})

    def __init__(
        self,
        model: newton.Model,
        *,
        sensing_bodies: str | Sequence[str] | Sequence[int] | None = None,
        sensing_shapes: str | Sequence[str] | Sequence[int] | None = None,
    ):
        if (sensing_bodies is None) == (sensing_shapes is None):
            raise InputError("a sensor takes either sensing_bodies or sensing_shapes")
        self.model = model
        if sensing_bodies is not None:
            self.sensing_indices = _chosen(model.body_label, sensing_bodies, "sensing_bodies")
            row_of_body = _rows(self.sensing_indices, model.body_count)
            bodies = model.shape_body.numpy()
            rows = np.where(bodies >= 0, row_of_body[bodies], -1) if model.body_count else np.full(len(bodies), -1)
        elif sensing_shapes is not None:
            self.sensing_indices = _chosen(model.shape_label, sensing_shapes, "sensing_shapes")
            rows = _rows(self.sensing_indices, model.shape_count)
        self._rows = wp.array(rows, dtype=wp.int32, device=model.device)
        count = len(self.sensing_indices)
        self.total_force = wp.zeros(count, dtype=wp.vec3, device=model.device)
        self.total_force_friction = wp.zeros(count, dtype=wp.vec3, device=model.device)

    def update(self, state: newton.State | None, contacts: newton.Contacts, *, observables: Any) -> None:
        """Read the forces of the last step; it only launches kernels.

        Args:
            state: Not used; it is here because Newton's sensor takes it.
            contacts: The contacts of that step.
            observables: The solver's container that the step wrote.

        Raises:
            InputError: The container has no contact forces, or those of other contacts.
        """
        wrenches = getattr(observables, "contact_f", None)
        if wrenches is None:
            raise InputError(
                "observables has no contact_f: make it by solver.observables(sensor.solver_observable_kinds, "
                "contacts=contacts) and give it to solver.step"
            )
        if observables.contacts is not contacts:
            raise InputError("contacts is not what the step had that wrote the observables")
        self.total_force.zero_()
        self.total_force_friction.zero_()
        inputs = [contacts.soft_contact_count, contacts.soft_contact_shape, contacts.soft_contact_normal]
        inputs += [contacts.rigid_contact_max, wrenches, self._rows]
        wp.launch(
            sum_soft_contacts,
            dim=contacts.soft_contact_max,
            inputs=inputs,
            outputs=[self.total_force, self.total_force_friction],
            device=self.model.device,
        )


def _chosen(labels: Sequence[str], wanted: str | Sequence[str] | Sequence[int], name: str) -> list[int]:
    found: list[int] = []
    for one in [wanted] if isinstance(wanted, str) else wanted:
        if isinstance(one, str):
            matches = [k for k, label in enumerate(labels) if fnmatchcase(label, one)]
        else:
            matches = [int(one)] if 0 <= int(one) < len(labels) else []
        if not matches:
            raise InputError(f"{name}: nothing in the model is {one!r}; there are {len(labels)}: {_some(labels)}")
        found += [k for k in matches if k not in found]
    if not found:
        raise InputError(f"{name} is empty; it must name what the sensor watches")
    return found


def _rows(indices: list[int], count: int) -> np.ndarray:
    rows = np.full(count, -1, np.int32)
    rows[indices] = np.arange(len(indices))
    return rows


def _some(labels: Sequence[str]) -> str:
    return ", ".join(labels[:4]) + (", …" if len(labels) > 4 else "")
