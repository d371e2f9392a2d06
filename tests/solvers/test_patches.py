"""Steps by patches: each block's part, on the host; on CUDA the same steps as launch by launch."""

import itertools
import warnings

import numpy as np
import pytest
import warp as wp
from cases import CUBE, jittered, mixed_forest, oracle_mesh

import warp_corot as wc
from warp_corot.discretization.groups import group_numbers, neighbour_groups
from warp_corot.solvers.explicit.patches import NO_SLOT, WARP, Patches, PatchSteps, layout_of, rest_rows

THREADS = 256
ROOM = 200 * 1024

CASES = {
    "mixed forest": mixed_forest,
    "beam": lambda: wc.TetForest.box((1, 1, 3), CUBE, 6),
    "general": jittered,
}


@pytest.fixture(params=CASES)
def mesh(request):
    return CASES[request.param]()


@pytest.fixture(params=[False, True], ids=["each", "shared"])
def groups(request, mesh):
    """The group of each element where these share their dilatation."""
    if not request.param:
        return None
    if isinstance(mesh, wc.TetForest):
        return group_numbers(mesh, np.arange(len(mesh.tets)))
    return neighbour_groups(mesh.points, mesh.tets)


@pytest.fixture(params=[1, 2, 7])
def patches(request, mesh, groups):
    return Patches.of(mesh.points, mesh.tets, request.param, THREADS, groups)


def parts(array, start):
    return [array[a:b] for a, b in itertools.pairwise(start)]


def nodes_of(patches, patch):
    """The mesh's nodes in a patch's order."""
    own = parts(patches.own, patches.own_start)[patch]
    return np.concatenate([own, parts(patches.halo, patches.halo_start)[patch]])


def test_every_node_is_owned_once(mesh, patches):
    assert np.array_equal(np.sort(patches.own), np.arange(len(mesh.points)))


def test_a_patch_computes_what_touches_its_nodes_and_nothing_else(mesh, patches):
    own, elements = parts(patches.own, patches.own_start), parts(patches.elements, patches.element_start)
    for nodes, of_patch, count in zip(own, elements, patches.computed, strict=True):
        computed = of_patch[:count]
        assert np.array_equal(np.sort(computed), np.flatnonzero(np.isin(mesh.tets, nodes).any(axis=1)))


def test_a_patch_measures_the_whole_groups_of_what_it_computes(mesh, groups, patches):
    elements = parts(patches.elements, patches.element_start)
    if groups is None:
        assert all(len(of_patch) == count for of_patch, count in zip(elements, patches.computed, strict=True))
        return
    numbers, ranks = (parts(array, patches.element_start) for array in (patches.groups, patches.ranks))
    for patch, (of_patch, count) in enumerate(zip(elements, patches.computed, strict=True)):
        wanted = np.flatnonzero(np.isin(groups, groups[of_patch[:count]]))
        assert np.array_equal(np.sort(of_patch), wanted)
        # One number for each group, and places from 0 on in the order of elements.
        for number in range(patches.group_counts[patch]):
            members = numbers[patch] == number
            assert len(np.unique(groups[of_patch[members]])) == 1
            assert np.array_equal(np.argsort(of_patch[members]), np.argsort(ranks[patch][members]))
            assert np.array_equal(np.sort(ranks[patch][members]), np.arange(members.sum()))
        assert patches.group_counts[patch] == len(np.unique(groups[wanted]))
    assert patches.most_members == np.bincount(groups).max()


def test_corners_are_the_elements_nodes(mesh, patches):
    elements, corners = parts(patches.elements, patches.element_start), parts(patches.corners, patches.element_start)
    for patch in range(patches.count):
        assert np.array_equal(nodes_of(patches, patch)[corners[patch]], mesh.tets[elements[patch]])


def test_the_first_elements_need_no_halo(patches):
    own, corners = np.diff(patches.own_start), parts(patches.corners, patches.element_start)
    for count, of_patch, interior in zip(own, corners, patches.interior, strict=True):
        needs = (of_patch >= count).any(axis=1)
        assert not needs[:interior].any()
        assert needs[interior:].all()


def test_neighbours_wait_for_one_another(patches):
    """A block may overwrite a buffer only because its readers are among the blocks it has heard from since."""
    owner = np.empty(len(patches.own), int)
    owner[patches.own] = np.repeat(np.arange(patches.count), np.diff(patches.own_start))
    heard = {(k, int(owner[n])) for k, halo in enumerate(parts(patches.halo, patches.halo_start)) for n in halo}
    assert heard == {(b, a) for a, b in heard}


def gathered(patches, per_corner):
    """Sums of the corners' values, as a block makes them: float [N, 3].

    Args:
        per_corner: [T, 4, 3].
    """
    total = np.full((len(patches.own), 3), np.nan)
    own, elements = parts(patches.own, patches.own_start), parts(patches.elements, patches.element_start)
    slots, bases = parts(patches.slots, patches.element_start), parts(patches.bases, patches.base_start)
    for patch in range(patches.count):
        values = np.zeros((bases[patch][-1], 3))
        mine = slots[patch] != NO_SLOT
        assert len(np.unique(slots[patch][mine])) == mine.sum()
        values[slots[patch][mine]] = per_corner[elements[patch]][mine]
        for place, node in enumerate(own[patch]):
            total[node] = 0.0
            for thread in range(place * patches.lanes, (place + 1) * patches.lanes):
                first, end = bases[patch][thread // WARP : thread // WARP + 2]
                total[node] += values[first + thread % WARP : end : WARP].sum(axis=0)
    return total


def test_sums_are_those_of_all_corners(mesh, patches):
    """To rounding of float64: the order of a few dozen terms of order one."""
    per_corner = np.random.default_rng(3).normal(size=(len(mesh.tets), 4, 3))
    expected = np.zeros((len(mesh.points), 3))
    np.add.at(expected, mesh.tets.ravel(), per_corner.reshape(-1, 3))
    assert np.abs(gathered(patches, per_corner) - expected).max() < 1e-13


def test_rest_rows_are_inverse_edges_and_volume(mesh):
    """To float32; none of the matrices is nearly singular."""
    rows = rest_rows(mesh.points, mesh.tets)
    x = mesh.points[mesh.tets]
    edges = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
    assert np.allclose(rows[:9].T.reshape(-1, 3, 3) @ edges, np.eye(3), atol=1e-5)
    assert np.allclose(rows[9], mesh.volumes, rtol=1e-6)


def test_a_layout_has_room_for_every_patch(mesh, patches):
    layout = layout_of(patches, THREADS, ROOM)
    if layout is None:
        assert patches.most_computed > 4 * THREADS or patches.most_own * patches.lanes > THREADS
        return
    assert 4 * layout.floats <= ROOM
    assert layout.nodes >= patches.most_nodes
    assert layout.slots >= patches.most_slots
    assert layout.elements * THREADS >= patches.most_computed
    assert layout.halo * THREADS >= patches.most_halo


def test_patches_are_for_cuda(mesh):
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1e3), device="cpu")
    assert PatchSteps.of(body, wc.Corotated().bind(body)) is None


# --- on the card ---------------------------------------------------------------------------------------------------

DEVICES = [str(device) for device in wp.get_cuda_devices()]
cuda = pytest.mark.skipif(not DEVICES, reason="patches are stepped on CUDA")


def organ(general):
    if general:
        return jittered(cells=(2, 2, 2), level=6)
    mesh = wc.TetForest.box((2, 2, 2), CUBE, 6)
    return mesh.refine(np.random.default_rng(1).choice(len(mesh.tets), 20, replace=False))


def run(general, steps, by_patches, *, keyframes=False, loads=False, poisson=0.4, strain=0.0, device=None):
    mesh = organ(general)
    rng = np.random.default_rng(2)
    young = rng.uniform(3e3, 3e4, len(mesh.tets))
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1e3), device=device or DEVICES[0])
    if strain:
        body.displacements = strain * CUBE * rng.uniform(-1.0, 1.0, mesh.points.shape)
    y = mesh.points[:, 2]
    low, high = np.flatnonzero(y < y.min() + 1e-9), np.flatnonzero(y > y.max() - 1e-9)
    body.fix(low)
    if keyframes:
        turned = 0.01 * CUBE * rng.normal(size=(3, len(high), 3))
        body.prescribe(high, times=[0.0, 0.004, 0.02], displacements=turned)
    if loads:
        body.load(np.arange(len(y)), 1e-4 * rng.normal(size=(len(y), 3)))
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=1e-5, damping=10.0))
    many = sim.recorded._stepper._many
    assert isinstance(many[0], PatchSteps)
    if not by_patches:
        many[0] = None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim.advance_steps(steps)
    held = np.union1d(low, high) if keyframes else low
    return body.displacements.numpy(), body.velocities.numpy(), body.reactions.numpy()[held], sim


@cuda
@pytest.mark.parametrize("general", [False, True])
@pytest.mark.parametrize("controls", [{}, {"keyframes": True}, {"loads": True}], ids=["held", "keyframes", "loads"])
@pytest.mark.parametrize("steps", [1, 300])
def test_the_same_steps_as_launch_by_launch(general, controls, steps):
    check_steps(general, steps, **controls)


MOVED, STRAINED = {"keyframes": True, "loads": True}, {"strain": 0.08}


@cuda
@pytest.mark.parametrize("general", [False, True])
@pytest.mark.parametrize("poisson", [0.45, 0.49])
@pytest.mark.parametrize(
    ("controls", "steps"),
    [({}, 300), (MOVED, 1), (MOVED, 300), (STRAINED, 1), (STRAINED, 30)],
    ids=["held", "moved", "moved on", "strained", "strained on"],
)
def test_steps_that_share_their_dilatation(general, poisson, controls, steps):
    check_steps(general, steps, poisson=poisson, **controls)


def check_steps(general, steps, **options):
    """In float32 with another order: within 2e-5 after some hundred damped steps, like blocks of small bodies."""
    found, expected = (run(general, steps, by_patches, **options) for by_patches in (True, False))
    worst = 0.0
    for of_patches, of_launches in zip(found[:3], expected[:3], strict=True):
        assert np.isfinite(of_patches).all()
        worst = max(worst, np.abs(of_patches - of_launches).max() / np.abs(of_launches).max())
    print(f"patches: {general=} {steps=} {options}: {worst:.1e}", flush=True)
    assert worst < 2e-5


@pytest.mark.parametrize("general", [False, True])
def test_the_strain_of_these_steps(general):
    """Some elements are turned over, some beyond a quarter of their volume, most are neither."""
    mesh = organ(general)
    rng = np.random.default_rng(2)
    rng.uniform(3e3, 3e4, len(mesh.tets))
    u = STRAINED["strain"] * CUBE * rng.uniform(-1.0, 1.0, mesh.points.shape)
    ratios = np.linalg.det(oracle_mesh(mesh).deformation_gradients(mesh.points + u))
    assert (ratios < 0).any()
    assert (np.abs(ratios - 1) > 0.25).mean() > 0.05


@cuda
def test_runs_are_the_same_bit_by_bit():
    for poisson in (0.4, 0.49):
        assert np.array_equal(*(run(False, 300, True, poisson=poisson)[0] for _ in range(2)))
