"""Small runs on several ranks, for ``tests/distributed``: ``mpirun -n 3 python ranked.py results forest,tets``.

Three ranks make the runs of one rank, two and three, one after another: every process takes seconds to start.
"""

import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

wp.config.quiet = True
wp.config.enable_backward = False

import grown_parts  # noqa: E402

import warp_corot as wc  # noqa: E402
from warp_corot.distributed import mpi  # noqa: E402
from warp_corot.distributed.mpi import TimedCommunicator, longest_wait  # noqa: E402


def graded() -> wc.TetForest:
    """A beam whose leaves are of three levels."""
    mesh = wc.TetForest.box((1, 1, 3), 0.064, level=4)
    for end in (0.05, 0.02):
        mesh = mesh.refine(np.flatnonzero(mesh.points[mesh.tets].mean(axis=1)[:, 2] < end))
    return mesh


def jittered() -> wc.TetMesh:
    """The same region in tetrahedra of any shape."""
    forest = wc.TetForest.box((1, 1, 3), 0.064, level=4)
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
    """A soft block that touches obstacles."""
    mesh = wc.TetForest.box((1, 1, 2), 0.05, level=4) if mesh is None else mesh
    return wc.SoftBody(mesh, wc.Isotropic(2e3, 0.3, 1000.0), device="cpu")


def organ() -> wc.SoftBody:
    """A ball whose surface lies within its tetrahedra, soft in one world and stiffer in another."""
    box = wc.TetForest.box((1, 1, 1), 0.045, level=6, origin=(-0.0225, -0.0225, 0.0625))
    phi = np.linalg.norm(box.points - (0.0, 0.0, 0.085), axis=1) - 0.02
    place = (box.cells, box.cell_size, box.origin, box.lattice, box.node_ends, box.tree)
    mesh = wc.TetForest(*place, box.up_axis, phi=phi)
    return wc.SoftBody(mesh, wc.Isotropic(np.array([[5e3], [1e4]]), 0.3, 1000.0), worlds=2, device="cpu")


def dented() -> wc.SoftBody:
    """The ball in one world, of elements that are bisected where a tool presses it."""
    return wc.SoftBody(organ().mesh, wc.Isotropic(5e3, 0.3, 1000.0), device="cpu")


#: Cases with contact.
TOUCHING = ("touched", "organ", "meeting", "organs", "pressed", "bdf2", "dented", "squeezed")
#: Cases whose meshes change.
REMESHED = ("stretched", "dented", "drawn", "squeezed")
#: Cases whose checkpoints several ranks keep.
KEPT = (*TOUCHING, "stretched", "drawn", "multigrid")


def obstacles_of(case: str) -> list[wc.Ground | wc.Tool]:
    """The obstacle on which the block falls, and the one that comes down on its edges, between its nodes."""
    if case not in TOUCHING:
        return []
    ground = wc.Ground((0.0, 1.0, 0.0), -0.002, friction=0.3)
    if case.startswith("organ") or case == "dented":
        probe = wc.Tool(wc.Sphere(0.006))
        probe.follow([0.0, 0.04], [[0.002, 0.0, 0.1125], [0.003, 0.0, 0.104]])
        return [wc.Ground((0.0, 0.0, 1.0), 0.0648), probe]
    if case == "meeting":
        ball = wc.Tool(wc.Sphere(0.01))
        ball.follow([0.0, 0.05], [[0.025, 0.093, 0.08], [0.025, 0.068, 0.08]])
        return [ground, ball]
    heights = np.array([0.049, 0.043, 0.026])
    if case == "touched":
        # A slower tool takes fewer steps.
        radius = 0.004
        tool = wc.Tool(wc.Capsule(radius, 0.06))
        heights = np.array([0.049, 0.043, 0.03]) + radius
    else:
        # On several ranks, implicit steps hold nodes only. A plate is never between nodes.
        tool = wc.Tool(wc.Ground((0.0, -1.0, 0.0), 0.0))
    tool.follow([0.0, 0.02, 0.05], np.stack([np.full(3, 0.03), heights, [0.04, 0.044, 0.05]], axis=1))
    return [ground, tool]


def meeting() -> list[wc.SoftBody]:
    """The same block, and a stiffer one that lies on it and is pressed into it."""
    mesh = wc.TetForest.box((1, 1, 1), 0.03, level=4, origin=(0.01, 0.0505, 0.065))
    return [touched(), wc.SoftBody(mesh, wc.Isotropic(5e3, 0.3, 1000.0), device="cpu")]


def organs() -> list[wc.SoftBody]:
    """The ball, and a block beside it, which it is pressed against."""
    mesh = wc.TetForest.box((1, 1, 1), 0.02, level=4, origin=(0.0202, -0.01, 0.075))
    block = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.3, 1000.0), worlds=2, device="cpu")
    block.fix("x > 0.039")
    return [organ(), block]


#: Integrators of cases that are not stepped by the default one.
INTEGRATORS = {
    "implicit": lambda: wc.BackwardEuler(0.01, preconditioner="diagonal"),
    "multigrid": lambda: wc.BackwardEuler(0.01),
    "newton": lambda: wc.BackwardEuler(0.01, tolerance=1e-3),
    "pressed": lambda: wc.BackwardEuler(0.0033),
    "bdf2": lambda: wc.BDF2(0.0025, preconditioner="diagonal"),
    "newmark": lambda: wc.Newmark(0.01, preconditioner="diagonal", tolerance=1e-3, viscosity=2e-3),
    "worlds": lambda: wc.SymplecticEuler(viscosity=2e-3),
    # Steps and passes come at the same times then.
    "organ": lambda: wc.SymplecticEuler(dt=1e-3),
    "organs": lambda: wc.SymplecticEuler(dt=1e-3),
    "stretched": lambda: wc.SymplecticEuler(dt=3e-4),
    "drawn": lambda: wc.BDF2(0.005),
    "squeezed": lambda: wc.BackwardEuler(0.0033),
    "dented": lambda: wc.SymplecticEuler(dt=4e-4),
}

#: Models of cases that have another than the default one.
MODELS = {"shared": wc.Corotated(rotation_level=2)}

CASES: dict[str, Callable[[], wc.SoftBody | list[wc.SoftBody]]] = {
    "forest": lambda: body_of(graded(), 0.49),
    "tets": lambda: body_of(jittered(), 0.49),
    "worlds": lambda: body_of(wc.TetForest.box((1, 1, 3), 0.064, level=4), 0.3, worlds=2),
    "touched": touched,
    "organ": organ,
    "meeting": meeting,
    "organs": organs,
    "stretched": lambda: stretched(),
    "dented": dented,
    "drawn": lambda: drawn(),
    "squeezed": lambda: touched(wc.TetForest.box((1, 1, 3), 0.05, level=4)),
    "pressed": lambda: touched(wc.TetForest.box((1, 1, 3), 0.05, level=4)),
    "bdf2": touched,
    "shared": lambda: body_of(graded(), 0.3),
    "implicit": lambda: body_of(graded(), 0.3),
    "multigrid": lambda: body_of(graded(), 0.3),
    "newton": lambda: body_of(graded(), 0.49, worlds=2),
    "newmark": lambda: body_of(jittered(), 0.3),
}


def after(name: str) -> float:
    """The time that a run goes on from its checkpoint [s]: steps with contact are short."""
    return 0.004 if name.startswith(("touch", "organ.")) or name == "organ" else 0.01


def moved(sim: wc.Simulation, body: wc.SoftBody) -> None:
    """Move a body for 0.04 s; its load ends during that time."""
    for number in (1, 2, 3):
        sim.advance_until(number / 100)
    body.load("z > 0.09 and z < 0.1", [0.0, 0.0, 0.0])
    sim.advance(0.01)


def stretched() -> wc.SoftBody:
    """A bar whose elements are bisected where a load stretches it, and merged elsewhere."""
    body = wc.SoftBody(wc.TetForest.box((4, 1, 1), 0.05, level=5), wc.Isotropic(6e3, 0.49, 1000.0), device="cpu")
    body.fix("x < 1e-9")
    body.load("x > 0.19", [0.15, 0.0, 0.0])
    return body


def drawn() -> wc.SoftBody:
    """A bar whose muscle shortens it, while its end is drawn away and aside."""
    mesh = wc.TetForest.box((4, 1, 1), 0.05, level=5)
    muscle = wc.TransverselyIsotropic(8e3, 5e3, 0.3, 0.3, 2e3, (1.0, 0.0, 0.0), 1000.0)
    body = wc.SoftBody(mesh, muscle, device="cpu")
    body.fix("x < 1e-9")
    places = [[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.02, 0.02, 0.0], [0.0, 0.02, 0.0]]
    body.prescribe("x > xmax - 1e-9", times=[0.0, 0.03, 0.06, 0.1], displacements=places)
    body.activate(500.0)
    return body


def options_of(case: str) -> dict[str, Any]:
    """The options with which a case is stepped."""
    integrator = INTEGRATORS.get(case, wc.SymplecticEuler)()
    contact = wc.Contact(friction=0.2, self_contact=True) if case in ("meeting", "organs") else None
    touching = {"obstacles": obstacles_of(case), "contact": contact}
    made: dict[str, Any] = {"model": MODELS.get(case), "integrator": integrator, **touching}
    if case in REMESHED:
        made["remesh"] = wc.OnlineRemesh(
            refine_above=1.02 if case == "dented" else 1.05,
            simplify_below=1.01,
            # The surface of the ball is that of its elements, which would be too coarse for the tool.
            min_level=6 if case == "dented" else 3,
            max_level=8,
            every=30 if isinstance(integrator, wc.SymplecticEuler) else 2,
            capacity=4000,
        )
    return made


def bodies_of(case: str) -> list[wc.SoftBody]:
    """The bodies of a case."""
    found = CASES[case]()
    return found if isinstance(found, list) else [found]


def gathered(arrays: list[wp.array]) -> np.ndarray | None:
    """Nodal arrays of all bodies on rank 0, one after another."""
    import warp_corot.distributed as wd

    found = [wd.gather(each) for each in arrays]
    return None if found[0] is None else np.concatenate(found)


def made(case: str, deterministic: bool, kept: Path | None) -> dict[str, np.ndarray | None]:
    """The results of a run; if a file is given, also those of the same run after a checkpoint in it."""
    import warp_corot.distributed as wd

    bodies, options = bodies_of(case), options_of(case)
    sim = wd.Simulation(bodies, deterministic=deterministic, **options)
    moved(sim, bodies[0])
    positions = [body.positions for body in bodies]
    found = {"x": gathered(positions), "v": gathered([body.velocities for body in bodies])}
    found["energy"] = np.array(sim.energy())
    found["elements"] = np.array([body.element_count for body in bodies])
    if sim.solves is not None:
        found["iterations"] = np.array(sim.solves)
    found["numbers"] = np.array([sim.steps, sim.dt, sim.time, *sim.dt_range])
    found |= {f"wrench{k}": each.wrench.numpy().copy() for k, each in enumerate(options["obstacles"]) if k}
    found["costs"] = np.array(sim.measured_costs(2))
    if kept is not None:
        sim.save(kept)
        sim.advance(after(case))
        # Positions of a body that is remeshed are in another array now.
        positions = [body.positions for body in bodies]
        found |= {"saved.x": gathered(positions), "saved.numbers": np.array([sim.steps, sim.time])}
        if case in REMESHED:
            found |= recorded_and_reset(sim, kept.with_name(f"{case}.{sim.size}.usda"))
    return {f"{case}.{deterministic}.{key}": value for key, value in found.items()}


def recorded_and_reset(sim: Any, stage: Path) -> dict[str, np.ndarray | None]:
    """Reset a run whose meshes have changed, record it from then on, and give the numbers of elements in the frames,
    and the positions."""
    import warp_corot.distributed as wd

    sim.reset()
    at_rest = gathered([body.displacements for body in sim.bodies])
    assert at_rest is None or not at_rest.any()
    elements = wd.record(sim, stage, duration=0.04, fps=100).elements
    return {"frames": np.array(elements), "again.x": gathered([body.positions for body in sim.bodies])}


def resumed(path: Path) -> dict[str, np.ndarray | None]:
    """The results of a run that resumes from a checkpoint."""
    import warp_corot.distributed as wd

    sim = wd.Simulation.load(path)
    sim.advance(after(path.stem))
    numbers = np.array([sim.steps, sim.time])
    return {f"{path.stem}.x": gathered([body.positions for body in sim.bodies]), f"{path.stem}.numbers": numbers}


def touched_in_parts(kept: Path) -> np.ndarray | None:
    """The run "touched" with a mesh of which each rank holds a part, saved, and recorded afterwards; the positions of
    all nodes on rank 0."""
    import warp_corot.distributed as wd

    body = touched(wd.box((1, 1, 2), 0.05, level=4))
    sim = wd.Simulation(body, deterministic=True, obstacles=obstacles_of("touched"))
    moved(sim, body)
    sim.save(kept)
    x = wd.gather(body.positions)
    wd.record(sim, kept.with_suffix(".usda"), duration=0.004, fps=250)
    return x


def forest_divided(kept: Path) -> np.ndarray | None:
    """The run "forest" of a mesh that rank 0 makes and divides, saved; the positions of all nodes on rank 0."""
    import warp_corot.distributed as wd

    def make() -> wc.TetForest:
        assert mpi.world().rank == 0
        return graded()

    mesh = wd.divided(make)
    body = body_of(mesh, 0.49)
    sim = wd.Simulation(body, deterministic=True)
    moved(sim, body)
    # Of the ranks that move a corner of a triangle, the first counts it.
    triangles, _ = sim.parts[0].surface_faces
    corners = mesh.points[triangles[mesh.numbers.owner[triangles].min(axis=1) == sim.rank]]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    np.testing.assert_allclose(sum(sim.comm.allgather(area)), 14 * 0.064**2, rtol=1e-9)
    said = ""
    try:
        wd.divided(lambda: wc.TetForest.box(level=-1))
    except wc.InputError as error:
        said = str(error)
    # All ranks learn what was wrong on rank 0.
    assert "level is -1" in said
    sim.save(kept)
    return wd.gather(body.positions)


def general_loaded(file: Path) -> np.ndarray | None:
    """The run "newmark" of a mesh that rank 0 reads from a file and divides, saved beside it; the positions of all
    nodes on rank 0."""
    import meshio

    import warp_corot.distributed as wd

    everybody, mesh = mpi.world(), jittered()
    tissue, tip = 2 + 3 * (mesh.points[mesh.tets].mean(axis=1)[:, 2] // 0.07).astype(int), mesh.points[:, 2] > 0.18
    if everybody.rank == 0:
        of_cells, of_points = {"tissue": [tissue]}, {"tip": tip.astype(np.uint8)}
        meshio.Mesh(mesh.points, [("tetra", mesh.tets)], of_points, of_cells).write(file)
    part = wd.load(file, up_axis="Y")
    np.testing.assert_array_equal(mesh.points[part.numbers.nodes], part.points)
    assert part.label_names == ("2", "5", "8")
    np.testing.assert_array_equal(part.labels, 1 + (tissue[part.numbers.elements] - 2) // 3)
    np.testing.assert_array_equal(part.node_sets["tip"], tip[part.numbers.nodes])
    body = body_of(part, 0.3)
    sim = wd.Simulation(body, deterministic=True, **options_of("newmark"))
    moved(sim, body)
    sim.save(file.with_suffix(".3.npz"))
    said = ""
    try:
        wd.load(file.with_name("no.vtu"))
    except wc.InputError as error:
        said = str(error)
    assert "no.vtu" in said
    return wd.gather(body.positions)


def worlds_in_parts(stage: Path) -> dict[str, np.ndarray | None]:
    """The run "worlds" with a mesh of which each rank holds a part, recorded; and once more with no disk space on the
    last rank."""
    import warp_corot.distributed as wd

    body = body_of(wd.box((1, 1, 3), 0.064, level=4), 0.3, worlds=2)
    sim = wd.Simulation(body, deterministic=True, integrator=INTEGRATORS["worlds"]())
    wd.record(sim, stage, duration=0.03, fps=100, world=0)
    np.save(stage.with_suffix(f".{sim.rank}.npy"), body.positions.numpy()[: len(body.mesh.points)])
    moved(sim, body)
    sim.save(stage.with_name(f"parts.{sim.size}.npz"))
    sim.collect()
    # Copies of other ranks' nodes are where these have them.
    whole = sim.comm.bcast(wd.gather(body.positions), root=0)
    np.testing.assert_array_equal(body.positions.numpy(), whole[body.mesh.numbers.in_worlds(2)])
    found = {"parts.x": whole if sim.rank == 0 else None, "recorded": np.array("")}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    if sim.rank == sim.size - 1:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        wd.record(sim, stage.with_name(f"full-{stage.name}"), duration=0.02, fps=100, world=0)
    except OSError as error:
        found["recorded"] = np.array(str(error))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    return found


def active(mesh: wc.TetForest) -> wc.SoftBody:
    """A muscle with active stress, along keyframes in its farther half."""
    muscle = wc.TransverselyIsotropic(8e3, 5e3, 0.3, 0.3, 2e3, (1.0, 0.0, 0.0), 1000.0)
    body = wc.SoftBody(mesh, muscle, device="cpu")
    body.fix("x < 1e-9")
    x = mesh.points[mesh.tets].mean(axis=1)[:, 0]
    body.activate(2e3 * x)
    body.activate(wc.Activation([0.0, 0.015, 0.03], np.multiply.outer([0.0, 2e3, 4e2], x[x > 0.1])), x > 0.1)
    return body


def active_alone(file: Path) -> None:
    """Save the positions of a muscle on one process."""
    one = wc.Simulation(active(wc.TetForest.box((4, 1, 1), 0.05, level=5)), integrator=wc.SymplecticEuler(dt=3e-4))
    one.advance(0.01)
    one.advance(0.01)
    np.save(file, one.body.positions.numpy())


def active_in_parts(kept: Path) -> None:
    """A muscle in parts follows its active stress as on one process, from a checkpoint, too."""
    import warp_corot.distributed as wd

    body = active(wd.box((4, 1, 1), 0.05, level=5))
    sim = wd.Simulation(body, deterministic=True, integrator=wc.SymplecticEuler(dt=3e-4))
    sim.advance(0.01)
    sim.save(kept)
    sim.advance(0.01)
    x, again = wd.gather(body.positions), resumed(kept)[f"{kept.stem}.x"]
    if sim.rank == 0:
        assert x is not None
        np.testing.assert_array_equal(again, x)
        assert abs(np.ptp(x[:, 0]) - 0.2) > 1e-5
        np.testing.assert_allclose(np.load(kept.with_name("active.npy")), x, atol=1e-7)


def kept_in_parts(kept: Path) -> None:
    """Save the run "worlds" of a mesh in parts."""
    import warp_corot.distributed as wd

    body = body_of(wd.box((1, 1, 3), 0.064, level=4), 0.3, worlds=2)
    sim = wd.Simulation(body, deterministic=True, integrator=INTEGRATORS["worlds"]())
    moved(sim, body)
    sim.save(kept)
    sim.von_mises()  # as recordings need it


def make_all(folder: Path, size: int, names: list[str]) -> None:
    """Make runs on the present ranks, and write their results. One rank keeps the checkpoint of "forest", from which
    several ranks resume; these keep those of ``KEPT``."""
    found: dict[str, Any] = {}
    for name in names:
        keeps = size == 1 or name in KEPT
        found |= made(name, True, folder / f"{name}.{size}.npz" if keeps else None)
    if size == 1 and "worlds" in names:
        kept_in_parts(folder / "parts.1.npz")
        active_alone(folder / "active.npy")
    if size == 1 and "organ" in names:
        # This rank compiles the kernels that three ranks need.
        grown_parts.assert_whole(grown_parts.blobs(), 0.33, max_level=4)
    if size > 2:
        alone = (folder / f"{name}.1.npz" for name in ("forest", *REMESHED))
        for path in (*alone, *(folder / f"{name}.{kept}.npz" for name in KEPT for kept in {size, 4})):
            if path.stem.split(".")[0] in names and path.exists():
                found |= resumed(path)
        if "forest" in names:
            found |= made("forest", False, None)
            found["divided.x"] = forest_divided(folder / "divided.3.npz")
            found |= resumed(folder / "divided.3.npz")
        if "newmark" in names:
            found["loaded.newmark.x"] = general_loaded(folder / "general.vtu")
            found |= resumed(folder / "general.3.npz")
        if "worlds" in names:
            active_in_parts(folder / "active.3.npz")
            found |= worlds_in_parts(folder / f"{size}.usda")
            for path in folder.glob("parts.?.npz"):
                found |= resumed(path)
        if "organ" in names:
            grown_parts.assert_whole(grown_parts.blobs(), 0.33, max_level=6, sliver=0.3)
            grown_parts.assert_whole(grown_parts.layers(), 0.08, max_level=3)
        if "organs" in names:
            grown_parts.assert_refuses()
            grown_parts.assert_whole(wc.Domain.sphere(0.05, device="cpu"), 0.013, max_level=7, surface_error=1e-4)
            grown_parts.assert_moves_as_whole(folder / f"grown.{size}.npz")
        if "touched" in names:
            found["parts.touched.x"] = touched_in_parts(folder / "touches.3.npz")
            found |= resumed(folder / "touches.3.npz")
    if mpi.world().rank == 0:
        np.savez(folder / f"{size}.npz", **found)
    else:
        assert all(value is None for key, value in found.items() if key.endswith((".x", ".v")))


def main() -> None:
    folder, names = Path(sys.argv[1]), sys.argv[2].split(",")
    everybody = mpi.world()
    if everybody.size != 3:
        make_all(folder, everybody.size, names)
        return
    # One rank, which compiles all kernels, then two, and then all three.
    alone = everybody.rank == 2
    some = TimedCommunicator(mpi.library().COMM_WORLD.Split(int(alone)), longest_wait())
    mpi.world = lambda: some  # type: ignore[assignment]
    if alone:
        make_all(folder, 1, names)
    mpi.meet(everybody)
    if not alone:
        make_all(folder, 2, names[:1])
    mpi.meet(everybody)
    mpi.world = lambda: everybody  # type: ignore[assignment]
    make_all(folder, 3, names)


if __name__ == "__main__":
    main()
