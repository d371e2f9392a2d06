"""Small runs on several ranks, for ``tests/distributed``: ``mpirun -n 3 python ranked.py results forest,tets``.

Three ranks make the runs of one rank, two and three, one after another: every process takes seconds to start.
"""

import resource
import sys
from pathlib import Path

import numpy as np
import warp as wp

wp.config.quiet = True
wp.config.enable_backward = False

import warp_corot as wc  # noqa: E402


def graded() -> wc.TetForest:
    """A beam whose leaves are of three levels."""
    mesh = wc.TetForest.box((1, 1, 3), 0.064, level=4)
    for end in (0.05, 0.02):
        mesh = mesh.refine(np.flatnonzero(mesh.points[mesh.tets].mean(axis=1)[:, 2] < end))
    return mesh


def jittered() -> wc.TetMesh:
    """The same region in tetrahedra of any shape."""
    forest = wc.TetForest.box((1, 1, 3), 0.064, level=5)
    noise = np.random.default_rng(20130705).normal(scale=8e-4, size=forest.points.shape)
    return wc.TetMesh(forest.points + noise, forest.tets)


def body_of(mesh: wc.TetForest | wc.TetMesh, poisson: float, worlds: int = 1) -> wc.SoftBody:
    """A soft body held at one end, stiffer towards the other, loaded in the middle and moved at the far end."""
    z = mesh.points[mesh.tets].mean(axis=1)[:, 2]
    young = 800.0 * (1.0 + 5.0 * z) * np.linspace(1.0, 1.5, worlds)[:, None]
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1000.0), worlds=worlds, device="cpu")
    body.fix(mesh.points[:, 2] < 0.003)
    body.prescribe("z > zmax - 0.003", times=[0.0, 0.05, 0.1], displacements=[[0, 0, 0], [0.02, 0, 0], [0.02, 0, 0.01]])
    body.load("z > 0.09 and z < 0.1", [0.0, 2e-3, 0.0])
    return body


def touched(mesh: wc.TetForest | None = None) -> wc.SoftBody:
    """A soft block."""
    mesh = wc.TetForest.box((1, 1, 2), 0.05, level=4) if mesh is None else mesh
    return wc.SoftBody(mesh, wc.Isotropic(2e3, 0.3, 1000.0), device="cpu")


def obstacles_of(case: str) -> list[wc.Ground | wc.Tool]:
    """What the block falls on, and what comes down on its edges, between its nodes."""
    if case != "touched":
        return []
    tool = wc.Tool(wc.Capsule(0.004, 0.06))
    tool.follow([0.0, 0.02, 0.05], [[0.03, 0.053, 0.04], [0.03, 0.047, 0.044], [0.03, 0.03, 0.05]])
    return [wc.Ground((0.0, 1.0, 0.0), -0.002, friction=0.3), tool]


#: Integrators of cases that are not stepped by the default one.
INTEGRATORS = {
    "implicit": lambda: wc.BackwardEuler(0.01, preconditioner="diagonal"),
    "newmark": lambda: wc.Newmark(0.01, preconditioner="diagonal", tolerance=1e-3, viscosity=2e-3),
    "worlds": lambda: wc.SymplecticEuler(viscosity=2e-3),
}

#: Models of cases that have another than the default one.
MODELS = {"shared": wc.Corotated(rotation_level=2)}

CASES = {
    "forest": lambda: body_of(graded(), 0.49),
    "tets": lambda: body_of(jittered(), 0.49),
    "worlds": lambda: body_of(wc.TetForest.box((1, 1, 3), 0.064, level=4), 0.3, worlds=2),
    "touched": touched,
    "shared": lambda: body_of(graded(), 0.3),
    "implicit": lambda: body_of(graded(), 0.3),
    "newmark": lambda: body_of(jittered(), 0.3),
}


def saved_and_loaded(results: Path, before: list[str], case: str) -> dict[str, np.ndarray]:
    """A run that goes on from a checkpoint, and one that was never stopped; and one from others' checkpoint."""
    import warp_corot.distributed as wd

    sim = wd.Simulation(CASES[case](), deterministic=True, obstacles=obstacles_of(case))
    sim.advance(0.03)
    mine = results.with_suffix(f".{case}.npz")
    sim.save(mine)
    sim.advance(0.02)
    found = {"saved.x": wd.gather(sim.body.positions)}
    for name, path in (("loaded", mine), *(("others", Path(other).with_suffix(f".{case}.npz")) for other in before)):
        again = wd.Simulation.load(path)
        again.advance(0.02)
        found |= {f"{name}.x": wd.gather(again.body.positions), f"{name}.numbers": np.array([again.steps, again.time])}
    return {f"{case}.{key}": value for key, value in found.items()}


def touched_in_parts() -> np.ndarray | None:
    """The run "touched" of a mesh that no rank holds whole; the positions of all nodes on rank 0."""
    import warp_corot.distributed as wd

    body = touched(wd.box((1, 1, 2), 0.05, level=4))
    sim = wd.Simulation(body, deterministic=True, obstacles=obstacles_of("touched"))
    sim.advance(0.03)
    body.load("z > 0.09 and z < 0.1", [0.0, 0.0, 0.0])
    sim.advance(0.01)
    return wd.gather(body.positions)


def in_parts() -> np.ndarray | None:
    """The run "worlds" of a mesh that no rank holds whole; the positions of all nodes on rank 0."""
    import warp_corot.distributed as wd

    body = body_of(wd.box((1, 1, 3), 0.064, level=4), 0.3, worlds=2)
    sim = wd.Simulation(body, deterministic=True, integrator=INTEGRATORS["worlds"]())
    sim.advance(0.03)
    body.load("z > 0.09 and z < 0.1", [0.0, 0.0, 0.0])
    sim.advance(0.01)
    sim.collect()
    # Copies of other ranks' nodes are where these have them.
    whole = sim.comm.bcast(wd.gather(body.positions), root=0)
    np.testing.assert_array_equal(body.positions.numpy(), whole[body.mesh.numbers.in_worlds(2)])
    return whole if sim.rank == 0 else None


def recorded(stage: Path) -> str:
    """Record a run of a mesh that no rank holds whole, and once more with no room on the last rank; what is raised."""
    import warp_corot.distributed as wd

    body = body_of(wd.box((1, 1, 3), 0.064, level=4), 0.3)
    sim = wd.Simulation(body, deterministic=True)
    wd.record(sim, stage, duration=0.02, fps=100)
    np.save(stage.with_suffix(f".{sim.rank}.npy"), body.positions.numpy()[: len(body.mesh.points)])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    if sim.rank == sim.size - 1:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        wd.record(sim, stage.with_name(f"full-{stage.name}"), duration=0.02, fps=100)
    except OSError as error:
        return str(error)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    return ""


def make_all(results: str, names: str, before: list[str]) -> None:
    """Make runs on the ranks that there are, and write what they find."""
    import warp_corot.distributed as wd

    found = {}
    for name in names.split(","):
        make = CASES[name]
        for deterministic in (True, False) if name == "forest" and names != "forest" else (True,):
            body = make()
            obstacles = obstacles_of(name)
            options = {
                "model": MODELS.get(name),
                "obstacles": obstacles,
                "integrator": INTEGRATORS.get(name, wc.SymplecticEuler)(),
            }
            sim = wd.Simulation(body, deterministic=deterministic, **options)
            sim.advance(0.03)
            body.load("z > 0.09 and z < 0.1", [0.0, 0.0, 0.0])
            sim.advance(0.01)
            kind = f"{name}.{deterministic}"
            found |= {f"{kind}.x": wd.gather(body.positions), f"{kind}.v": wd.gather(body.velocities)}
            found |= {f"{kind}.numbers": np.array([sim.steps, sim.dt, sim.time, *sim.dt_range])}
            found |= {f"{kind}.energy": np.array(sim.energy())}
            found |= {f"{kind}.wrench{k}": each.wrench.numpy() for k, each in enumerate(obstacles) if k}
    found["costs"] = np.array(sim.measured_costs())
    for name in ("forest", "touched"):
        if name in names:
            found |= saved_and_loaded(Path(results), before, name)
    if "worlds" in names:
        found |= {"parts.x": in_parts(), "parts.touched.x": touched_in_parts()}
        found["recorded"] = np.array(recorded(Path(results).with_suffix(".usda")))
    if sim.rank == 0:
        np.savez(results, **found)
    else:
        assert all(value is None for key, value in found.items() if key.endswith((".x", ".v")))


def main() -> None:
    from warp_corot.distributed import mpi
    from warp_corot.distributed.patience import Patient, patience

    folder, names = Path(sys.argv[1]), sys.argv[2]
    everybody = mpi.world()
    if everybody.size != 3:
        make_all(str(folder / f"{everybody.size}.npz"), names, [])
        return
    # Two ranks and one beside them, and then all three, which go on from the checkpoint of the one.
    alone = everybody.rank == 2
    some = Patient(mpi.library().COMM_WORLD.Split(int(alone)), patience())
    mpi.world = lambda: some  # type: ignore[assignment]
    make_all(str(folder / f"{some.size}.npz"), names if alone else "forest", [])
    mpi.meet(everybody)
    mpi.world = lambda: everybody  # type: ignore[assignment]
    make_all(str(folder / "3.npz"), names, [str(folder / "1.npz")])


if __name__ == "__main__":
    main()
