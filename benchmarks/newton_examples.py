#!/usr/bin/env python3
"""Newton's examples with the line of their solver changed, beside its own solvers.

    python benchmarks/newton_examples.py [--frames 30] [--device cpu] [--scenes hanging gift franka organ grasp]

``hanging`` (4 grids of 960 tetrahedra), ``gift`` (4 blocks and 2 straps) and ``franka`` (a duck, which Newton
downloads) are Newton's own, with 10 steps a frame of 1/60 s. In ``gift`` contact of soft bodies takes two more lines.
``organ`` is a soft mesh of 5 kPa that falls 2 cm on a ground, ``grasp`` a block that two plates press and lift;
Newton's solvers make 10 steps a frame in these, this package's solver one, or two implicit ones; ``collide`` is called
once a frame. Solvers alternate frame by frame, each with its own copy; medians leave out the first frames.

"deep": how deep a particle's sphere got in a shape. "volume": mean change of the tetrahedra's volume at the end;
"folded": how many are inside out then.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import newton
import newton.examples
import numpy as np
import warp as wp
from measure import machine, table

import warp_corot as wc
from warp_corot.newton import SolverCorotated, add_mesh

SKIPPED, DT = 4, 1.0 / 60.0
#: Solvers of a model, and the steps of a frame in the scenes of this file.
SOLVERS: dict[str, tuple[Callable[..., Any], int]] = {
    "VBD, 10 iterations": (lambda model, **_: newton.solvers.SolverVBD(model, iterations=10), 10),
    "XPBD, 10 iterations": (lambda model, **_: newton.solvers.SolverXPBD(model, iterations=10), 10),
    "SolverCorotated": (lambda model, **options: SolverCorotated(model, **options), 1),
    "SolverCorotated, implicit": (lambda model, **_: SolverCorotated(model, integrator="implicit"), 2),
}
MODULES = {
    "hanging": "newton.examples.softbody.example_softbody_hanging",
    "gift": "newton.examples.multiphysics.example_softbody_gift",
    "franka": "newton.examples.softbody.example_softbody_franka",
}
#: Distance at which soft bodies of ``gift`` begin to push one another [m].
MARGIN = 0.04


class Theirs:
    """One of Newton's examples, with another solver unless it is VBD."""

    def __init__(self, name: str, solver: str, device: str):
        module, made = importlib.import_module(MODULES[name]), SOLVERS[solver][0]
        touches = name == "gift" and solver == "SolverCorotated"
        options = {"self_contact_margin": MARGIN} if touches else {}
        original = newton.solvers.SolverVBD, newton.CollisionPipeline
        if not solver.startswith("VBD"):
            newton.solvers.SolverVBD = lambda model, **_: _with_bvh(made(model, **options))
            module.SolverVBD = newton.solvers.SolverVBD
        if touches:
            newton.CollisionPipeline = _SelfContact
        try:
            with wp.ScopedDevice(device):
                args = newton.examples.create_parser().parse_args(["--viewer", "null", "--device", device, "--quiet"])
                args.solver = "vbd"
                if not solver.startswith("VBD"):
                    # A first step finds what a recording cannot.
                    module.Example.capture, capture = lambda self: None, module.Example.capture
                    self._example = module.Example(newton.viewer.ViewerNull(), args)
                    module.Example.capture = capture
                    self._example.simulate()
                    self._example.capture()
                else:
                    self._example = module.Example(newton.viewer.ViewerNull(), args)
        finally:
            newton.solvers.SolverVBD, newton.CollisionPipeline = original
        self.model = self._example.model

    @property
    def state(self) -> newton.State:
        return self._example.state_0

    def frame(self) -> None:
        self._example.step()


class _SelfContact(newton.CollisionPipeline):
    def __init__(self, model: newton.Model, **options: Any):
        super().__init__(model, **options)
        self.init_soft_self_contact(margin=MARGIN, gap=0.02, topological_filter_threshold=1)

    def collide(self, state: newton.State, contacts: newton.Contacts, **_: Any) -> None:
        super().collide(state, contacts, soft_self_contact=True)


def _with_bvh(solver: Any) -> Any:
    """What ``franka`` asks of VBD alone does nothing."""
    solver.rebuild_bvh = lambda state: None
    return solver


class Ours:
    """A scene of this file."""

    def __init__(self, name: str, solver: str, device: str):
        self.model, self._place = SCENES[name](device)
        made, self._steps = SOLVERS[solver]
        self._solver, self._pipeline = made(self.model), newton.CollisionPipeline(self.model)
        self._contacts, self._states = self._pipeline.contacts(), [self.model.state(), self.model.state()]
        self._time = 0.0

    @property
    def state(self) -> newton.State:
        return self._states[0]

    def frame(self) -> None:
        dt = DT / self._steps
        for step in range(self._steps):
            before, after = self._states
            before.clear_forces()
            if self._place is not None:
                poses, twists = self._place(self._time), (self._place(self._time + dt) - self._place(self._time)) / dt
                before.body_q.assign(np.pad(poses, ((0, 0), (0, 4))) + np.eye(7)[6])
                before.body_qd.assign(np.pad(twists, ((0, 0), (0, 3))))
            if step == 0:
                self._pipeline.collide(before, self._contacts)
            self._solver.step(before, after, None, self._contacts, dt)
            self._states.reverse()
            self._time += dt


def organ(device: str) -> tuple[newton.Model, None]:
    """A ring of some 3,000 tetrahedra that falls over."""
    forest = wc.TetForest.from_domain(wc.Domain.torus(0.035, 0.015), target_elements=3000, device="cpu")
    slant = (np.sin(0.7), 0.0, 0.0, np.cos(0.7))
    builder = newton.ModelBuilder()
    tissue = wc.Isotropic(young=5e3, poisson=0.44, density=1000.0)
    add_mesh(builder, wc.TetMesh(forest.points, forest.tets), tissue, rot=slant, particle_radius=0.002)
    lowest = min(q[2] for q in builder.particle_q)
    builder.particle_q = [(x, y, z + 0.022 - lowest) for x, y, z in builder.particle_q]
    return _finished(builder, device, ke=1e4, mu=0.3), None


def grasp(device: str) -> tuple[newton.Model, Callable[[float], np.ndarray]]:
    """A block of 50 kPa, 10 cm wide, that two plates press by 12 mm each in 0.2 s and lift at 0.2 m/s."""
    builder = newton.ModelBuilder()
    forest = wc.TetForest.box((1, 1, 1), 0.1, 9, up_axis="Z")
    tissue = wc.Isotropic(young=5e4, poisson=0.4, density=500.0)
    block = wc.TetMesh(forest.points, forest.tets)
    add_mesh(builder, block, tissue, pos=(-0.05, -0.05, 0.003), k_damp=20.0, particle_radius=0.002)
    for _ in range(2):
        plate = builder.add_body()
        builder.add_shape_box(plate, hx=0.02, hy=0.06, hz=0.04)
        builder.body_flags[plate] = int(newton.BodyFlags.KINEMATIC)

    def place(t: float) -> np.ndarray:
        x = 0.072 - 0.014 * min(t / 0.2, 1.0)
        z = 0.05 + 0.2 * max(t - 0.3, 0.0)
        return np.array([[-x, 0.0, z], [x, 0.0, z]])

    return _finished(builder, device, ke=2e3, mu=0.8), place


SCENES: dict[str, Callable[[str], Any]] = {"organ": organ, "grasp": grasp}


def _finished(builder: newton.ModelBuilder, device: str, *, ke: float, mu: float) -> newton.Model:
    builder.add_ground_plane()
    builder.color()
    model = builder.finalize(device=device)
    for name, value in (("ke", ke), ("kd", 0.0), ("kf", 1e3), ("mu", mu)):
        setattr(model, f"soft_contact_{name}", value)
        getattr(model, f"shape_material_{name}").fill_(value)
    return model


# --- measures --------------------------------------------------------------------------------------------------------


def depth(scene: Theirs | Ours) -> float:
    """How deep a particle's sphere is in the ground or, in ``grasp``, in a plate [m]."""
    model, q = scene.model, scene.state.particle_q.numpy().astype(float)
    radius = model.particle_radius.numpy()
    deep = float((radius - q[:, 2]).max())
    if isinstance(scene, Ours) and model.body_count:
        for pose in scene.state.body_q.numpy():
            inside = np.array([0.02, 0.06, 0.04]) - np.abs(q - pose[:3])
            deep = max(deep, float((radius[:, None] + inside).min(axis=1).max()))
    return max(deep, 0.0)


def shape(scene: Theirs | Ours) -> tuple[float, int]:
    """The mean change of volume, and the number of elements that are inside out."""
    model = scene.model
    x = scene.state.particle_q.numpy().astype(float)[model.tet_indices.numpy().reshape(-1, 4)]
    poses = model.tet_poses.numpy().astype(float).reshape(-1, 3, 3)
    ratio = np.linalg.det(np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)) * np.linalg.det(poses)
    rest = 1.0 / np.linalg.det(poses)
    return float((np.abs(ratio - 1.0) * rest).sum() / rest.sum()), int((ratio <= 0.0).sum())


def compared(name: str, device: str, frames: int) -> list[list[str]]:
    """The rows of a scene."""
    runs: dict[str, Theirs | Ours] = {}
    said: dict[str, str] = {}
    for solver in SOLVERS:
        try:
            runs[solver] = (Ours if name in SCENES else Theirs)(name, solver, device)
        except Exception as error:  # an example that needs a download, or a model that a solver refuses
            said[solver] = " ".join(str(error).split())[:60]
    times: dict[str, list[float]] = {solver: [] for solver in runs}
    deepest = dict.fromkeys(runs, 0.0)
    for _ in range(frames):
        for solver, scene in list(runs.items()):
            with wp.ScopedDevice(device):
                wp.synchronize_device()
                started = time.perf_counter()
                try:
                    scene.frame()
                except Exception as error:
                    said[solver] = " ".join(str(error).split())[:60]
                    del runs[solver]
                    continue
                wp.synchronize_device()
            times[solver].append(time.perf_counter() - started)
            deepest[solver] = max(deepest[solver], depth(scene))
    medians = {solver: float(np.median(times[solver][SKIPPED:])) for solver in runs}
    rows = []
    for solver in SOLVERS:
        if solver not in runs:
            rows.append([name, solver, "-", "-", "-", "-", said[solver]])
            continue
        change, folded = shape(runs[solver])
        if not change < 10.0:
            rows.append([name, solver, f"{1e3 * medians[solver]:.1f}", "-", "-", "-", "it flies apart"])
            continue
        ratio = next(iter(medians.values())) / medians[solver]
        figures = [
            f"{1e3 * medians[solver]:.1f}",
            f"{ratio:.2g}",
            f"{1e3 * deepest[solver]:.2f}",
            f"{100 * change:.2g} %",
        ]
        rows.append([name, solver, *figures, str(folded)])
    return rows


def main() -> int:
    of = argparse.ArgumentParser(description=__doc__.split("\n")[0], prog="newton_examples.py")
    of.add_argument("--frames", type=int, default=30)
    of.add_argument("--device", default="cpu")
    of.add_argument("--scenes", nargs="+", choices=[*MODULES, *SCENES], default=[*MODULES, *SCENES])
    options = of.parse_args()
    warnings.simplefilter("ignore")
    print(", ".join(str(value) for value in machine(wp.get_device(options.device)).values()))
    rows = []
    for name in options.scenes:
        rows += compared(name, options.device, options.frames)
    print(table(["scene", "solver", "ms a frame", "times as fast", "deep, mm", "volume", "folded"], rows, 2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
