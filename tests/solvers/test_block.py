"""Steps of small bodies in one thread block for each world, on CUDA, against the same steps launch by launch.

A few worlds are stepped by patches, in place of blocks, and are tested here, too. All ways are float32 and sum in
different orders; damped, they agree within ``ONE`` after a step and ``MANY`` after many.
"""

import warnings

import numpy as np
import oracle
import pytest
import warp as wp
from cases import CUBE, jittered, mixed_forest, oracle_mesh, random_displacement

import warp_corot as wc
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.solvers.explicit.block import BlockSteps
from warp_corot.solvers.explicit.patches import PatchSteps
from warp_corot.solvers.recorded import Segment

DEVICES = [str(device) for device in wp.get_cuda_devices()]
pytestmark = pytest.mark.skipif(not DEVICES, reason="blocks are for CUDA")

DAMPING, GRAVITY, DT = 10.0, (0.3, -9.8, 0.1), 1e-4
ONE, MANY = 1e-5, 2e-5
OWN = wc.Corotated()
MANY_WORLDS = 300  # more than there are multiprocessors, for which a block is divided differently

#: A body for each type of subtree; the last is the paper's beam.
BODIES = {
    "type 0": ((1, 1, 1), 3),
    "type 1": ((2, 1, 1), 4),
    "type 2": ((1, 1, 2), 5),
    "beam": ((1, 1, 3), 6),
}


@pytest.fixture(params=DEVICES or ["none"])
def device(request):
    return request.param


def forest(name):
    cells, level = BODIES[name]
    return wc.TetForest.box(cells, CUBE, level)


def material(form, mesh, worlds):
    """A material with one number, one for each world, each element, or each element in each world."""
    rng = np.random.default_rng(5)
    t = len(mesh.tets)
    size = {"uniform": (), "worlds": (worlds, 1), "elements": (t,), "both": (worlds, t)}[form]
    return wc.Isotropic(rng.uniform(2e3, 8e3, size), rng.uniform(0.2, 0.45, size), rng.uniform(500, 1500, size))


def made(
    device,
    mesh,
    *,
    launches,
    by=BlockSteps,
    form="uniform",
    worlds=1,
    amount=0.1,
    dt=DT,
    start=None,
    loads=True,
    shared=False,
):
    """A block fixed at one end, pulled at the other, with loads everywhere, from a random start; stepped launch by
    launch or ``by`` blocks or patches, even if the other ones are faster."""
    rng = np.random.default_rng(9)
    n = len(mesh.points)
    body = wc.SoftBody(mesh, material(form, mesh, worlds), worlds=worlds, device=device)
    if start is None:
        start = np.stack([random_displacement(mesh, rng, amount) for _ in range(worlds)])
    body.displacements = start
    body.velocities = np.broadcast_to(rng.normal(0, 0.05, (n, 3)), (worlds, n, 3))
    z = mesh.points[:, 2]
    held, pulled = np.flatnonzero(z < 1e-9), np.flatnonzero(z > z.max() - 1e-9)
    body.fix(held)
    body.prescribe(pulled, velocity=rng.normal(0, 0.1, (worlds, 1, 3)))
    if loads:
        body.load(np.arange(n), rng.normal(0, 0.01, (worlds, n, 3)))
    integrator = wc.SymplecticEuler(dt=dt, damping=DAMPING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wc.StabilityWarning)
        model = wc.Corotated(dilatation="shared" if shared else "element")
        sim = wc.Simulation(body, model=model, integrator=integrator, gravity=GRAVITY)
    many = sim.recorded._stepper._many
    assert isinstance(many[0], BlockSteps) or worlds < MANY_WORLDS
    many[0] = by.of(body, sim.fields[0])
    assert many[0] is not None
    if launches:
        many[0] = None
    assert isinstance(sim.fields[0], DilatationField) == shared
    return sim


def assert_near(sim, other, tolerance):
    """Displacements, velocities and reactions of all worlds, relative to the largest of each in a world."""
    for name in ("displacements", "velocities", "reactions"):
        a, b = (getattr(s.body, name).numpy().reshape(s.worlds, -1, 3) for s in (sim, other))
        assert np.isfinite(a).all()
        scale = np.abs(b).max(axis=(1, 2), keepdims=True)
        worst = (np.abs(a - b) / scale).max()
        print(f"{name} differ by {worst:.1e}")
        assert worst < tolerance, name


def pair(device, mesh, **options):
    return [made(device, mesh, launches=launches, **options) for launches in (False, True)]


# --- the same steps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["uniform", "elements"])
@pytest.mark.parametrize("name", BODIES)
def test_steps_equal_those_by_launches(name, form, device):
    sims = pair(device, forest(name), form=form)
    for sim in sims:
        sim.step()
    assert_near(*sims, ONE)
    for sim in sims:
        sim.advance_steps(99)
        assert sim.steps == 100
    assert_near(*sims, MANY)


@pytest.mark.parametrize("worlds", [3, MANY_WORLDS])
@pytest.mark.parametrize("form", ["uniform", "worlds", "elements", "both"])
def test_steps_of_worlds_equal_those_by_launches(form, worlds, device):
    sims = pair(device, forest("type 1"), form=form, worlds=worlds)
    for sim in sims:
        sim.step()
    assert_near(*sims, ONE)
    for sim in sims:
        sim.advance_steps(99)
    assert_near(*sims, MANY)


@pytest.mark.parametrize("shared", [False, True], ids=["each", "shared"])
@pytest.mark.parametrize("worlds", [1, 3, 16])
@pytest.mark.parametrize("form", ["uniform", "worlds", "elements", "both"])
def test_patches_of_a_few_worlds_equal_steps_by_launches(form, worlds, shared, device):
    """Keyframes move the end of one world, too."""
    if wp.get_device(device).sm_count < 4 * worlds:
        pytest.skip("too few multiprocessors")
    mesh = forest("beam")
    top = np.flatnonzero(mesh.points[:, 2] > mesh.points[:, 2].max() - 1e-9)
    sims = pair(device, mesh, by=PatchSteps, form=form, worlds=worlds, dt=5e-5, shared=shared)
    for sim in sims:
        sim.step()
    assert_near(*sims, ONE)
    for sim in sims:
        place = sim.body.world(worlds - 1).displacements.numpy()[top]
        frames = np.stack([place, place + 0.01 * CUBE])
        sim.body.prescribe(top, times=[0.0, 0.01], displacements=frames, worlds=[worlds - 1])
        sim.advance_steps(99)
    assert_near(*sims, MANY)


@pytest.mark.parametrize(
    ("name", "worlds", "steps"),
    [("beam", 1, PatchSteps), ("beam", 16, PatchSteps)]
    + [(name, worlds, BlockSteps) for name, worlds in (("type 1", 1), ("type 1", 3), ("beam", MANY_WORLDS))],
)
def test_a_few_worlds_are_stepped_by_patches_and_many_by_blocks(name, worlds, steps, device):
    if wp.get_device(device).sm_count < 64:
        pytest.skip("too few multiprocessors for 16 worlds")
    body = wc.SoftBody(forest(name), wc.Isotropic(5e3, 0.4, 1e3), worlds=worlds, device=device)
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=1e-5))
    assert isinstance(sim.recorded._stepper._many[0], steps)


@pytest.mark.parametrize("worlds", [1, MANY_WORLDS])
@pytest.mark.parametrize(("name", "form"), [("type 0", "uniform"), ("type 1", "both"), ("type 2", "elements")])
def test_steps_that_share_their_dilatation(name, form, worlds, device):
    check_shared_steps(name, form, worlds, device)


@pytest.mark.parametrize("worlds", [1, MANY_WORLDS])
def test_steps_of_the_beam_that_shares_its_dilatation(worlds, device):
    check_shared_steps("beam", "uniform", worlds, device)


def check_shared_steps(name, form, worlds, device):
    """The start takes some elements beyond a quarter of their volume."""
    sims = pair(device, forest(name), form=form, worlds=worlds, amount=0.25, dt=2e-5, shared=True)
    for steps, most in ((1, ONE), (30, MANY)):
        for sim in sims:
            sim.advance_steps(steps)
        assert_near(*sims, most)


@pytest.mark.parametrize("worlds", [1, MANY_WORLDS])
def test_a_step_is_that_of_float64(worlds, device):
    """v1 = (v0 + dt (f/m + g)) / (1 + dt damping), u1 = u0 + dt v1, reactions -(f + m g), f with the loads."""
    mesh = forest("type 1")
    sim = made(device, mesh, launches=False, form="both", worlds=worlds)
    body, reference = sim.body, oracle_mesh(mesh)
    shape = (worlds, len(mesh.points), 3)
    u, v = (getattr(body, name).numpy().astype(float).reshape(shape) for name in ("displacements", "velocities"))
    loads = body.loads.numpy().reshape(shape)
    held = body.constrained.reshape(shape[:2])
    sim.step()
    after = {name: getattr(body, name).numpy().reshape(shape) for name in ("displacements", "velocities", "reactions")}
    for world in range(0, worlds, 37):
        of_world = body.material
        mu, lam = oracle.lame(of_world.young[world], of_world.poisson[world])
        mass = reference.masses(of_world.density[world])[:, None]
        _, force = oracle.evaluate("corotated", reference, mesh.points + u[world], mu, lam)
        force = force + loads[world]
        free = ~held[world][:, None]
        v1 = np.where(free, (v[world] + DT * (force / mass + GRAVITY)) / (1 + DT * DAMPING), v[world])
        reaction = np.where(free, 0.0, -(force + mass * GRAVITY))
        expected = {"velocities": v1, "displacements": u[world] + DT * v1, "reactions": reaction}
        for name, values in expected.items():
            np.testing.assert_allclose(
                after[name][world], values, rtol=0, atol=ONE * np.abs(values).max(), err_msg=name
            )


@pytest.mark.parametrize("shared", [False, True], ids=["each", "shared"])
@pytest.mark.parametrize("worlds", [1, MANY_WORLDS])
def test_crushed_and_mirrored_subtrees_are_repaired(worlds, shared, device):
    """Every second world is mirrored and squeezed, but all rotations stay defined."""
    mesh = forest("type 1")
    rng = np.random.default_rng(3)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    F = turn @ np.diag([1.5, 0.9, -0.3]) @ turn.T
    mirrored = mesh.points @ (F - np.eye(3)).T + random_displacement(mesh, rng, 0.02)
    plain = random_displacement(mesh, rng, 0.1)
    start = np.stack([mirrored if world % 2 == 0 else plain for world in range(worlds)])
    gradients = oracle_mesh(mesh).deformation_gradients(mesh.points + start[0])
    assert (np.linalg.det(gradients) < -0.1).all()
    sims = pair(device, mesh, worlds=worlds, start=start, dt=2e-5, shared=shared)
    for sim in sims:
        sim.step()
    assert_near(*sims, ONE)
    for sim in sims:
        sim.advance_steps(30)
    assert_near(*sims, MANY)


def test_single_crushed_subtrees_are_repaired(device):
    """A few elements of one subtree are inverted: only some of a block's threads repair it."""
    mesh = forest("beam")
    start = random_displacement(mesh, np.random.default_rng(1), 0.1)
    inside = np.linalg.norm(mesh.points - mesh.points.mean(axis=0), axis=1).argmin()
    edge = np.cbrt(6.0 * mesh.volumes[0])
    start[inside] += edge * np.array([0.5, 1.6, 0.3], np.float32)
    gradients = oracle_mesh(mesh).deformation_gradients(mesh.points + start)
    assert 0 < (np.linalg.det(gradients) < 0).sum() < 20
    sims = pair(device, mesh, start=start[None])
    for sim in sims:
        sim.step()
    assert_near(*sims, ONE)


# --- what changes on the way ---------------------------------------------------------------------------------------


def test_supports_and_loads_may_change(device):
    mesh = forest("type 2")
    sims = pair(device, mesh, worlds=2, loads=False)
    z = mesh.points[:, 2]
    top = np.flatnonzero(z > z.max() - 1e-9)
    for sim in sims:
        sim.advance_steps(30)
        sim.body.release(top, worlds=1)
        sim.body.fix(top, worlds=0)
        sim.body.load(top, [0.0, 0.02, 0.0], worlds=1)
        sim.advance_steps(70)
        sim.body.load(top, [0.0, 0.0, 0.0])
        sim.body.world(0).velocities.zero_()
        sim.advance_steps(30)
    assert_near(*sims, MANY)


def test_keyframes_for_a_while(device):
    """From blocks to launches and back: nothing is lost in between."""
    sims = pair(device, forest("type 1"))
    top = np.flatnonzero(sims[0].body.mesh.points[:, 2] > CUBE - 1e-9)
    for sim in sims:
        sim.advance_steps(40)
        place = sim.body.displacements.numpy()[top]
        sim.body.prescribe(top, times=[0.0, 0.01], displacements=np.stack([place, place]))
        sim.advance_steps(40)
        sim.body.release(top)
        sim.advance_steps(40)
    assert_near(*sims, MANY)


def test_recorded_steps(device):
    """In a capture a step is one launch that is replayed."""
    sims = [made(device, forest("type 1"), launches=False) for _ in range(2)]
    with wp.ScopedCapture(device=device) as capture:
        sims[0].step()
    for _ in range(20):
        wp.capture_launch(capture.graph)
    sims[1].advance_steps(20)
    assert sims[0].steps == 20
    for name in ("displacements", "velocities", "reactions", "positions"):
        a, b = (getattr(sim.body, name).numpy() for sim in sims)
        np.testing.assert_array_equal(a, b, err_msg=name)


# --- alone, together and again -------------------------------------------------------------------------------------


def test_runs_are_the_same_bit_by_bit(device):
    """Nothing is added atomically, so ``deterministic`` is not needed."""
    ends = []
    for _ in range(2):
        sim = made(device, forest("beam"), launches=False, worlds=3, form="worlds")
        sim.advance_steps(300)
        ends.append(np.concatenate([sim.body.displacements.numpy(), sim.body.reactions.numpy()]))
    np.testing.assert_array_equal(*ends)


def test_a_world_among_many_is_as_alone(device):
    mesh = forest("type 2")
    sim = made(device, mesh, launches=False, worlds=MANY_WORLDS)
    alone = [made(device, mesh, launches=False, loads=False) for _ in range(2)]
    sim.body.load(np.arange(len(mesh.points)), [0.0, 0.0, 0.0])
    for one, world in zip(alone, (0, MANY_WORLDS - 1), strict=True):
        one.body.displacements = sim.body.world(world).displacements.numpy()
        velocities = sim.body.world(world).velocities.numpy()
        one.body.velocities = velocities
        pulled = mesh.points[:, 2] > mesh.points[:, 2].max() - 1e-9
        one.body.prescribe(pulled, velocity=velocities[pulled])
        one.advance_steps(100)
    sim.advance_steps(100)
    for one, world in zip(alone, (0, MANY_WORLDS - 1), strict=True):
        u, v = (getattr(sim.body.world(world), name).numpy() for name in ("displacements", "velocities"))
        np.testing.assert_allclose(one.body.displacements.numpy(), u, rtol=0, atol=MANY * np.abs(u).max())
        np.testing.assert_allclose(one.body.velocities.numpy(), v, rtol=0, atol=MANY * np.abs(v).max())


@pytest.mark.parametrize("share", [1.15, 3.0])
def test_an_unstable_step_is_named(share, device):
    """Even in the middle of the steps of one launch: the step before left a finite state."""
    mesh = forest("type 1")
    dt = share * made(device, mesh, launches=False).stable_dt
    sims = [made(device, mesh, launches=False, dt=dt) for _ in range(2)]
    with pytest.raises(wc.UnstableError, match=r"since step (\d+)") as caught:
        sims[0].advance_steps(2000)
    step = int(str(caught.value).split("since step ")[1].split(" ")[0])
    assert step > 5
    # Without checks, which would end the run before.
    sims[1].recorded.replay(Segment(step - 1))
    assert np.isfinite(sims[1].body.state.displacements.numpy()).all()
    sims[1].recorded.replay(Segment(1))
    assert not np.isfinite(sims[1].body.state.displacements.numpy()).all()


def test_a_world_that_is_not_finite_leaves_the_others(device):
    mesh = forest("type 1")
    dt = 0.8 * made(device, mesh, launches=False).stable_dt  # for all worlds, even if one fails
    sims = [made(device, mesh, launches=False, worlds=3, dt=dt) for _ in range(2)]
    for sim in sims:
        sim.body.set_initial_state()
    free = np.flatnonzero(~sims[0].body.constrained[: len(mesh.points)])
    velocities = sims[0].body.world(1).velocities.numpy().copy()
    velocities[free[3]] = np.nan
    sims[0].body.world(1).velocities.assign(velocities)
    with pytest.raises(wc.UnstableError, match=r"since step 1 .* in world 1;"):
        sims[0].advance_steps(50)
    sims[1].advance_steps(50)
    for world in (0, 2):
        a, b = (sim.body.world(world).displacements.numpy() for sim in sims)
        np.testing.assert_array_equal(a, b)
    for sim in sims:
        sim.reset([1])
        sim.advance_steps(50)
    a, b = (sim.body.displacements.numpy() for sim in sims)
    assert np.isfinite(a).all()
    np.testing.assert_array_equal(a, b)


def test_bodies_that_blocks_do_not_step(device):
    """Too large, with several kinds of subtrees, without subtrees, with another law, or with shared rotations."""
    beam = wc.TetForest.box((1, 1, 3), CUBE, 6)
    large = wc.TetForest.box((5, 5, 1), CUBE, 6)
    small = wc.Isotropic(5e3, 0.4, 1e3)
    for mesh, model in (
        (large, OWN),
        (mixed_forest(), OWN),
        (jittered(), OWN),
        (beam, wc.Linear()),
        (beam, wc.Corotated(rotation="svd")),
        (beam, wc.Corotated(rotation_level=3)),
        (beam, wc.Linear(dilatation="shared")),
    ):
        body = wc.SoftBody(mesh, small, device=device)
        assert BlockSteps.of(body, model.bind(body)) is None
    body = wc.SoftBody(beam, small, device="cpu")
    assert BlockSteps.of(body, OWN.bind(body)) is None
