"""The number of substeps that the current state needs; see ``kernels.stepping.gauge``."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity import Corotated
from warp_corot.kernels.newton import gauge as newton_gauge
from warp_corot.kernels.stepping import gauge
from warp_corot.mesh.growing.cut import linked, node_pairs
from warp_corot.solvers.guarding.mapped import Mapped
from warp_corot.solvers.steps.gauge import REST_TURNS
from warp_corot.solvers.steps.stable_step import PROBE

from .library import newton
from .tetrahedra import Tetrahedra

#: Number of substeps between measurements. A measurement takes about as long as four substeps.
INTERVAL = 64
#: A recorded step has at least this many times the substeps that the model needs at rest, since it cannot change them.
HEADROOM = 1.5
#: Number of retries of a failed step, each with twice the substeps.
RETRIES = 4
#: Factor on the used fraction of the safe substep at each measurement after a retry.
RECOVERY = 1.02


class Following:
    """The safe substep of a model, which follows the state by launches that may be recorded.

    On the CPU the host gets the result of a measurement at once. On CUDA it does not wait: it uses the values that the
    device has written to the host's memory so far.

    Args:
        model: The model.
        tetrahedra: Its tetrahedra. Everything else in the model is assumed to be as stiff as at rest.

    Attributes:
        share: The fraction of the safe substep that is used; less than one after a failed step.
        reach: The size of the largest body [m]: a larger motion in a substep is a failure.
        made: Number of substeps of the last step.
        was_recorded: Whether the last step was recorded.
    """

    def __init__(self, model: newton.Model, tetrahedra: Tetrahedra):
        self.model, self.tetrahedra = model, tetrahedra
        self.device = model.device
        count = model.particle_count
        self._directions, self._probed_x, self._probed_u, self._f, self._f_probed = (
            wp.zeros(size, dtype=wp.vec4, device=self.device)
            for size in (count, len(tetrahedra.x), len(tetrahedra.u), count, count)
        )
        self._found = wp.zeros((1, 2), dtype=wp.float32, device=self.device)
        self._of_model = self._found[0]
        self._at_rest = wp.zeros((1, 4), dtype=wp.float64, device=self.device)
        self._allowed = wp.zeros(1, dtype=wp.float64, device=self.device)
        self._turn = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._excess = wp.zeros(1, dtype=wp.float32, device=self.device)
        self._seen = Mapped(1, self.device)
        self.share, self.made, self.was_recorded = 1.0, 1, False
        self.reach = _size(model, tetrahedra.tets)
        self._since, self._recording = INTERVAL, False
        # Loading kernels within a recording would end it on some drivers.
        wp.load_module(newton_gauge.find_posed_strains.module, self.device)

    def find_rest(self, stable: float) -> None:
        """Set the largest stable substep at rest [s], the reference of measurements."""
        model, tets = self.model, self.tetrahedra
        active = (model.particle_flags.numpy() & int(newton.ParticleFlags.ACTIVE)) != 0
        inverse = np.where(active, model.particle_inv_mass.numpy(), 0.0)
        of_elements = np.zeros(len(inverse), bool)
        of_elements[tets.tets] = True
        self._inverse_mass = self._on_device(inverse * of_elements)
        chosen = np.zeros(len(inverse), bool)
        chosen[tets.nodes_by_displacements] = True
        self._by_displacements = self._on_device(inverse * chosen)
        chosen = np.zeros(len(inverse), bool)
        chosen[tets.nodes_by_positions] = True
        self._by_positions = self._on_device(inverse * chosen)
        lightest = float((inverse * of_elements).max())
        size = float(tets.elements.volume.numpy().min()) ** (1.0 / 3.0)
        self._scale = wp.full(1, PROBE * size / math.sqrt(lightest) if lightest > 0 else 0.0, wp.float32, self.device)
        row = [stable, self._curvature_at_rest(), Corotated.step_safety, Corotated.strained_safety]
        self._longest = stable * Corotated.step_safety
        if not math.isfinite(stable):
            row[0] = self._longest = 1e30
        self._at_rest.assign(np.array([row]))
        self._allowed.fill_(self._longest)
        self._seen.values[0] = self._longest
        self._since = INTERVAL

    @property
    def substep(self) -> float:
        """The substep that the host would use now [s]; does not wait."""
        return self.share * float(self._seen.values[0])

    @property
    def recorded_substep(self) -> float:
        """The longest substep that would be recorded now [s]; does not wait."""
        return min(self.substep, self._longest / HEADROOM)

    def count_for(self, dt: float) -> int:
        """Number of substeps in a time [s]."""
        longest = self.recorded_substep if self.device.is_capturing else self.substep
        # A quotient that exceeds one by rounding counts as one.
        return max(1, math.ceil(dt / longest * (1.0 - 1e-6)))

    def is_due(self) -> bool:
        """Whether the next substep begins with a measurement; the first one of a recording does."""
        begins, self._recording = self.device.is_capturing and not self._recording, self.device.is_capturing
        self.was_recorded = self.device.is_capturing
        due = begins or self._since >= INTERVAL
        self._since = 1 if due else self._since + 1
        return due

    def measure(self, state: newton.State, dt: float, substep: float) -> None:
        """Measure at a state whose positions and displacements have been gathered.

        Args:
            state: The state.
            dt: The remaining time of the step [s].
            substep: The planned length of a substep [s].
        """
        tets, model = self.tetrahedra, self.model
        for base, probed, inverse_mass in (
            (tets.x, self._probed_x, self._by_positions),
            (tets.u, self._probed_u, self._by_displacements),
        ):
            if not len(base):
                continue
            self._f.zero_()
            outputs = [self._directions, probed, self._f_probed]
            self._launch(gauge.probe_directions, [self._scale, inverse_mass, base], outputs)
            for at, f in ((base, self._f), (probed, self._f_probed)):
                by_positions = base is tets.x
                tets.add_elastic_forces(at if by_positions else None, None if by_positions else at, f)
            inputs = [inverse_mass, base, probed, self._f, self._f_probed]
            self._launch(gauge.find_curvatures, inputs, [self._directions, self._of_model])
        ahead = max(dt, INTERVAL * substep)
        inputs = [tets.elements, state.particle_q, state.particle_qd, ahead, model.tet_count, self._turn]
        looked_at = -(-model.tet_count // int(gauge.TURNS))
        self._launch(newton_gauge.find_posed_strains, inputs, [self._found], looked_at)
        recorded = substep if self.device.is_capturing else 0.0
        inputs = [self._at_rest, wp.float64(recorded)]
        outputs = [self._found, self._allowed, self._turn, self._excess, self._seen.array]
        self._launch(newton_gauge.take_safe_substep, inputs, outputs, 1)
        self.recover()

    def recover(self) -> None:
        """Increase the used fraction of the safe substep a little after a failed step."""
        self.share = min(1.0, RECOVERY * self.share)

    def take_excess(self) -> float:
        """The largest factor by which recorded substeps were too long since the last call; waits for the device."""
        excess = float(self._excess.numpy()[0])
        if excess > 0.0:
            self._excess.zero_()
        return excess

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _curvature_at_rest(self) -> float:
        """The largest curvature about rest shapes [1/s^2]; measurements start with its directions."""
        tets = self.tetrahedra
        u, probed = (wp.zeros(self.model.particle_count, dtype=wp.vec4, device=self.device) for _ in range(2))
        self._directions.zero_()
        self._f.zero_()
        for _ in range(REST_TURNS):
            self._found.zero_()
            outputs = [self._directions, probed, self._f_probed]
            self._launch(gauge.probe_directions, [self._scale, self._inverse_mass, u], outputs)
            tets.add_linear_forces(probed, self._f_probed)
            inputs = [self._inverse_mass, u, probed, self._f, self._f_probed]
            self._launch(gauge.find_curvatures, inputs, [self._directions, self._of_model])
        value = float(self._found.numpy()[0, 0])
        self._found.zero_()
        return value

    def _on_device(self, values: npt.NDArray[np.floating]) -> wp.array:
        return wp.array(values, dtype=wp.float32, device=self.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list, dim: int | None = None) -> None:
        count = self.model.particle_count if dim is None else dim
        wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=self.device)


def _size(model: newton.Model, tets: npt.NDArray[np.integer]) -> float:
    """The diagonal of the bounding box of the largest connected body of tetrahedra [m]."""
    count = model.particle_count
    body = linked(node_pairs(tets), count)
    number, x = int(body.max()) + 1, model.particle_q.numpy()
    low, high = (np.full((number, 3), value) for value in (np.inf, -np.inf))
    np.minimum.at(low, body, x)
    np.maximum.at(high, body, x)
    return float(np.linalg.norm(high - low, axis=1).max())
