"""The forces of every law on every path, in every state of a body."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp
from measure import WRONG, Case, kind
from problem import SUBTREE_LEVELS, Sample, drawn_nodes, oracle, padded
from shared_reference import pressure_forces
from solver_cases import put_back
from state_bodies import GRAVITY, MATERIAL, State, Subject

import warp_corot as wc
from warp_corot.elasticity import ForceField, Model
from warp_corot.elasticity.dilatation import DilatationField, law_of
from warp_corot.errors import InputError

#: Fibres along y, three times as stiff as across.
FIBRES = (3 * MATERIAL["young"], MATERIAL["young"], 0.4, MATERIAL["poisson"], MATERIAL["young"] / 3)
#: Number of nodes whose forces are checked, and for anisotropic ones, where the oracle takes second differences. Single
#: nodes that a state has moved are checked, too.
NODES, FIBRE_NODES = 300, 30
#: Elements are left out of the check if s2 + s3 is below this fraction of s1: their rotation is undefined.
DEFINITE = 0.02
#: General meshes with more elements are not made.
MOST_GENERAL = 10_000_000
#: Whole steps are timed for bodies with at most this many elements.
MOST_STEPPED = {"cuda": 200_000, "cpu": 20_000}
#: Their step, as a fraction of the default one: the state hardly changes.
STEP_SHARE = 0.01
#: Errors are relative to the largest force, or, if that is smaller, to the force of this strain, of which float32
#: rounds away a hundred-thousandth.
LEAST_STRAIN = 1e-2

DEFAULT, LEAF, GENERAL = "default", "leaf by leaf", "general mesh"


@dataclass
class Row:
    """A law in a state, and the cases that time it by path.

    Attributes:
        state: The body's state; law: its name; paths: cases by path.
        flagged: The fraction of subtrees that the default path leaves to the robust rotation, after a run.
    """

    state: State
    law: str
    paths: dict[str, Case]
    flagged: Callable[[], float | None]


def rows_of(subject: Subject, states: list[State], device: wp.Device, laws: tuple[str, ...] | None) -> list[Row]:
    """Every law on every path in every state."""
    bench = Bench(subject, states, device)
    found = []
    for law, paths in bench.fields(laws).items():
        if laws is None or law in laws:
            for state in states:
                cases = {path: bench.force_case(state, law, path, field) for path, field in paths.items()}
                found.append(Row(state, law, cases, lambda field=paths[DEFAULT]: flagged_share(field)))
    if len(subject.mesh.tets) <= MOST_STEPPED[kind(device)] and (laws is None or STEP in laws):
        sims = bench.simulations()
        for state in states:
            cases = {path: bench.step_case(state, path, sim) for path, sim in sims.items()}
            found.append(Row(state, STEP, cases, lambda: None))
    return found


#: The names of rows that are whole steps, and of rows with fibres.
STEP = "corotated, whole step"
FIBRED = "transversely isotropic"


def models(level: int) -> Iterator[tuple[str, str, Model]]:
    """Names of laws, the oracle's names, and the models themselves."""
    yield "corotated", "corotated", wc.Corotated()
    if level >= SUBTREE_LEVELS:
        yield f"corotated, rotations {SUBTREE_LEVELS} up", "shared", wc.Corotated(rotation_level=level - SUBTREE_LEVELS)
    with contextlib.suppress(InputError, TypeError, ValueError):  # of versions without it
        yield "corotated, auto", "auto", wc.Corotated(rotation_level="auto")  # type: ignore[arg-type]
    yield "linear", "linear", wc.Linear()
    yield "StVK", "stvk", wc.StVenantKirchhoff()
    yield "neo-Hookean", "neo_hookean", wc.NeoHookean()


def flagged_share(field: ForceField) -> float | None:
    """The fraction of its subtrees that a field's last launch left to the robust rotation."""
    batches = getattr(getattr(field, "plan", None), "batches", ())
    flags = [batch.flagged.numpy()[: batch.count] != 0 for batch in batches]
    return float(np.concatenate(flags).mean()) if flags else None


class Bench:
    """The bodies of one subject: a forest and a general mesh, isotropic and with fibres.

    Attributes:
        groups: By path, the group of each element of one world that shares a dilatation; none where elements do not.
    """

    def __init__(self, subject: Subject, states: list[State], device: wp.Device):
        self.subject, self.device = subject, device
        mesh = subject.mesh
        self.fill = 1.0 if mesh.fill is None else mesh.fill
        self.level = int(np.bincount(mesh.levels).argmax())
        moved = [np.flatnonzero(state.u.any(axis=1)) for state in states]
        single = np.concatenate([nodes for nodes in moved if len(nodes) < FIBRE_NODES])
        self.sample, self.few = (
            Sample(mesh.points, mesh.tets, nodes=np.append(drawn_nodes(len(mesh.points), count), single))
            for count in (NODES, FIBRE_NODES)
        )
        self.mu, self.lam = (float(value) for value in oracle.lame(MATERIAL["young"], subject.poisson))
        self.groups: dict[str, np.ndarray] = {}
        self.C = oracle.elasticity(*oracle.transverse(*FIBRES), axes=np.roll(np.eye(3), 2, axis=0))
        #: The array for forces.
        self.f = wp.zeros(len(mesh.points) * subject.worlds, dtype=wp.vec4, device=device)
        self._u: dict[int, wp.array] = {}
        self._forces: dict[tuple[int, str, str | None], np.ndarray] = {}
        self._definite: dict[tuple[int, str], np.ndarray] = {}

    def meshes(self) -> Iterator[tuple[str, wc.TetForest | wc.TetMesh, np.ndarray | float]]:
        """Meshes by path, with the filled fraction of each element for the material."""
        mesh = self.subject.mesh
        yield DEFAULT, mesh, 1.0
        if len(mesh.tets) * self.subject.worlds <= MOST_GENERAL:
            yield GENERAL, wc.TetMesh(mesh.points, mesh.tets), self.fill

    def body(self, mesh: wc.TetForest | wc.TetMesh, material: wc.Isotropic | wc.TransverselyIsotropic) -> wc.SoftBody:
        return wc.SoftBody(mesh, material, worlds=self.subject.worlds, device=self.device, threads=1)

    def isotropic(self, share: np.ndarray | float) -> wc.Isotropic:
        return wc.Isotropic(MATERIAL["young"] * share, self.subject.poisson, MATERIAL["density"] * share)

    def fibres(self, share: np.ndarray | float) -> wc.TransverselyIsotropic:
        along, across, *ratios, shear = FIBRES
        density = MATERIAL["density"] * share
        return wc.TransverselyIsotropic(
            along * share, across * share, *ratios, shear * share, direction=(0.0, 1.0, 0.0), density=density
        )

    def fields(self, laws: tuple[str, ...] | None) -> dict[str, dict[str, ForceField]]:
        """Force fields of some or all laws by law and path; laws without a subtree path have no leaf-by-leaf one."""
        found: dict[str, dict[str, ForceField]] = {}
        self.reference: dict[str, str] = {}
        for path, mesh, share in self.meshes():
            body = self.body(mesh, self.isotropic(share))
            for name, reference, model in models(self.level):
                if not (laws is None or name in laws or (name == "corotated" and STEP in laws)):
                    continue
                if path == GENERAL and getattr(model, "rotation_level", None) is not None:
                    continue
                self.reference[name] = reference
                fields = found.setdefault(name, {})
                fields[path] = model.bind(body)
                sharing = law_of(fields[path])[1]
                if sharing is not None and path not in self.groups:
                    self.groups[path] = numbers_of_one_world(sharing, len(mesh.tets))
                if path == DEFAULT and "subtrees" in {f.name for f in dataclasses.fields(model)}:
                    fields[LEAF] = dataclasses.replace(model, subtrees=False).bind(body)
            if laws is not None and FIBRED not in laws:
                continue
            fibres = self.body(mesh, self.fibres(share))
            fields = found.setdefault(FIBRED, {})
            fields[path] = wc.Corotated().bind(fibres)
            if path == DEFAULT:
                fields[LEAF] = wc.Corotated(subtrees=False).bind(fibres)
        self.reference[FIBRED] = "fibres"
        return found

    def simulations(self) -> dict[str, wc.Simulation]:
        found = {}
        for path, mesh, share in self.meshes():
            for name, model in ((path, wc.Corotated()), (LEAF, wc.Corotated(subtrees=False))):
                if name == GENERAL or path == DEFAULT:
                    body = self.body(mesh, self.isotropic(share))
                    body.fix(self.subject.held)
                    default = wc.Simulation(body, model=model).dt
                    integrator = wc.SymplecticEuler(STEP_SHARE * default)
                    found[name] = wc.Simulation(body, model=model, integrator=integrator, gravity=GRAVITY)
        return found

    # --- cases --------------------------------------------------------------------------------------------------------

    @property
    def tets(self) -> int:
        """Elements of all worlds."""
        return len(self.subject.mesh.tets) * self.subject.worlds

    @property
    def checked_world(self) -> slice:
        """The nodes of the middle world."""
        count = len(self.subject.points)
        return slice(self.subject.worlds // 2 * count, (self.subject.worlds // 2 + 1) * count)

    def force_case(self, state: State, law: str, path: str, field: ForceField) -> Case:
        """``field.add_forces`` in a state."""
        u, f = self.on_device(state), self.f

        def error() -> float:
            f.zero_()
            field.add_forces(u, f)
            found = f.numpy()[self.checked_world, :3]
            return self.error(state, self.reference[law], found, shared=self.sharing(law, path))

        # The oracle does not know rotations that the device chooses: the error is the effect of sharing.
        wrong = None if self.reference[law] == "auto" else WRONG
        named = f"{self.subject.name}, {state.name}", f"{law}, {path}"
        return Case(*named, lambda: field.add_forces(u, f), error, self.tets, wrong=wrong)

    def step_case(self, state: State, path: str, sim: wc.Simulation) -> Case:
        """Whole steps from a state, always the same ones; the change of velocities in the first one is checked."""
        start, body = self.on_device(state), sim.body
        steps = 512 if self.device.is_cuda else int(np.clip(1_000_000 // self.tets, 64, 512))

        def error() -> float:
            put_back(body, start)
            sim.advance_steps(1)
            mass = body.masses[self.checked_world, None]
            found = mass * body.velocities.numpy()[self.checked_world] / sim.dt
            loads, free = mass * np.array(GRAVITY), ~self.subject.held
            return self.error(state, "corotated", found, loads, free, self.sharing("corotated", path))

        return Case(
            f"{self.subject.name}, {state.name}",
            f"{STEP}, {path}",
            lambda: sim.advance_steps(steps),
            error,
            self.tets,
            repeats=steps,
            recorded=False,
            reset=lambda: put_back(body, start),
        )

    def on_device(self, state: State) -> wp.array:
        """Displacements vec4 of all worlds."""
        if id(state) not in self._u:
            u = np.tile(padded(state.u), (self.subject.worlds, 1))
            self._u[id(state)] = wp.array(u, dtype=wp.vec4, device=self.device)
        return self._u[id(state)]

    # --- references ---------------------------------------------------------------------------------------------------

    def sharing(self, law: str, path: str) -> str | None:
        """The path whose groups a law's elements share their dilatation in, or None."""
        of_path = GENERAL if path == GENERAL else DEFAULT
        return of_path if of_path in self.groups and self.reference.get(law) != "fibres" else None

    def error(
        self,
        state: State,
        reference: str,
        found: np.ndarray,
        loads: np.ndarray | None = None,
        free: np.ndarray | None = None,
        shared: str | None = None,
    ) -> float:
        """Error of forces [N, 3] of one world, at the sample's nodes whose elements have definite rotations.

        Args:
            loads: Other forces included in them [N, 3].
            free: Nodes to compare, bool [N]; None for all.
            shared: As ``sharing`` has it.
        """
        sample = self.few if reference == "fibres" else self.sample
        keep = self.definite(state, reference, sample) & (True if free is None else free[sample.nodes])
        nodes = sample.nodes[keep]
        wanted = self.forces(state, reference, shared)[keep] + (0.0 if loads is None else loads[nodes])
        if not np.isfinite(found[nodes]).all():
            return float("inf")
        least = LEAST_STRAIN * MATERIAL["young"] * float(np.max(sample.mesh.volumes)) ** (2 / 3)
        return float(np.abs(found[nodes] - wanted).max() / max(np.abs(wanted).max(), least))

    def definite(self, state: State, reference: str, sample: Sample) -> np.ndarray:
        """Which nodes of a sample are only in elements whose rotation is definite, bool [n]."""
        key = id(state), reference
        if key not in self._definite:
            F = sample.mesh.deformation_gradients(self.x(state, sample))
            indefinite = is_indefinite(F)
            if reference == "shared":
                indefinite |= is_indefinite(self._ancestors_gradients(state))
            near = np.zeros(len(sample.used), bool)
            near[sample.mesh.tets[indefinite]] = True
            self._definite[key] = ~near[sample.rows]
        return self._definite[key]

    def x(self, state: State, sample: Sample) -> np.ndarray:
        """Positions of the nodes in a sample's elements, float64."""
        return self.subject.points[sample.used] + state.u[sample.used].astype(float)

    def forces(self, state: State, reference: str, shared: str | None = None) -> np.ndarray:
        """The float64 forces [n, 3] of a sample."""
        key = id(state), reference, shared
        if key not in self._forces:
            self._forces[key] = self._found_forces(state, reference, shared)
        return self._forces[key]

    def _found_forces(self, state: State, reference: str, shared: str | None) -> np.ndarray:
        if reference == "fibres":
            sample, law, options = self.few, oracle.anisotropic, {}
            C = np.broadcast_to(self.C, (len(sample.elements), 3, 3, 3, 3))
            mu, lam = C * self._shares(sample)[:, None, None, None, None], None
        else:
            sample, options = self.sample, {}
            name = {"shared": "corotated", "auto": "corotated"}.get(reference, reference)
            law, of_law = oracle.DENSITIES[name], 0.0 if shared is not None else self.lam
            mu, lam = (value * self._shares(sample) for value in (self.mu, of_law))
            if reference == "shared":
                options = {"R": oracle.polar(self._ancestors_gradients(state))}
        found = oracle.continuum(law, sample.mesh, self.x(state, sample), mu, lam, **options)[1][sample.rows]
        if shared is not None:
            mesh = self.subject.mesh
            of_all = self.lam * np.broadcast_to(self.fill, len(mesh.tets))
            found += pressure_forces(name, sample, mesh.points, mesh.tets, state.u, self.groups[shared], of_all)
        return found

    def _shares(self, sample: Sample) -> np.ndarray:
        """The filled fraction of each element of a sample [m]."""
        return np.broadcast_to(self.fill, len(self.subject.mesh.tets))[sample.elements]

    def _ancestors_gradients(self, state: State) -> np.ndarray:
        """F of the ancestor whose rotation each element of the sample shares [m, 3, 3]."""
        mesh = self.subject.mesh
        ancestors = mesh.ancestors(self.level - SUBTREE_LEVELS)[self.sample.elements]
        tets = mesh.tree.rows(ancestors)[0]
        used, local = np.unique(tets, return_inverse=True)
        at_rest = oracle.Mesh(mesh.points[used], local.reshape(-1, 4))
        return at_rest.deformation_gradients(mesh.points[used] + state.u[used].astype(float))


def numbers_of_one_world(field: DilatationField, count: int) -> np.ndarray:
    """The group of each element of the first world, int [count]."""
    return field.group_numbers()[:count]


def is_indefinite(F: np.ndarray) -> np.ndarray:
    """Where rotations of F [m, 3, 3] depend on their last digits, bool [m]."""
    s = np.linalg.svd(F, compute_uv=False)
    return s[:, 1] + np.sign(np.linalg.det(F)) * s[:, 2] < DEFINITE * s[:, 0]
