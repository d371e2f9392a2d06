"""Bodies without given supports: the chosen patch supports them, and their estimated sag agrees with beam theory."""

import functools

import numpy as np
import pytest
import trimesh

import warp_corot as wc
from warp_corot.holding.choice import BodyShape, flat_region, supports_of
from warp_corot.holding.sag import CoarseBody, MeshBody
from warp_corot.mesh.topology import boundary_faces, pieces_of

GRAVITY = np.array([0.0, 0.0, -9.81])
DENSITY = 1000.0


def shaped(move, level=6, cells=(2, 2, 2)) -> wc.TetMesh:
    """A ball of radius one, made of tetrahedra, with moved points."""
    box = wc.TetForest.box(cells, 1.0, level)
    x = box.points - box.points.mean(axis=0)
    x /= np.abs(x).max(axis=0)
    # From a cube to a ball: each shell of the cube becomes one of the ball.
    radius, length = np.abs(x).max(axis=1), np.linalg.norm(x, axis=1)
    ball = x * np.divide(radius, length, out=np.zeros_like(length), where=length > 0)[:, None]
    return wc.TetMesh(move(ball), box.tets, up_axis="Z")


def kidney(x):
    """Supported at one pole, bent."""
    y = x * [0.025, 0.02, 0.055]
    return y - np.outer(6.0 * y[:, 2] ** 2, [1.0, 0.0, 0.0])


def gall_bladder(x):
    """A pear with its thin end down, tilted."""
    y = x * [0.018, 0.018, 0.045] * (1.0 + 0.6 * np.clip(x[:, 2:], -1.0, 0.0)) ** [1.0, 1.0, 0.0]
    return turned(y, 40.0)


def liver(x):
    """A wedge with a thin lobe."""
    thick = (1.0 - x[:, 0]) / 2.0
    y = x * [0.11, 0.06, 0.0]
    y[:, 2] = x[:, 2] * (0.012 + 0.05 * thick)
    return turned(y, 25.0)


def turned(x, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return x @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T


def soft(mesh) -> float:
    """The command's Young's modulus for a body of unknown material."""
    return 20.0 * DENSITY * 9.81 * float(np.ptp(mesh.points[:, 2]))


def held(mesh, young=None):
    return supports_of(mesh, young=young or soft(mesh), density=DENSITY, gravity=GRAVITY)


def largest_displacement(mesh, nodes, young, seconds) -> float:
    """Largest displacement of any node, sampled 40 times a second, over the height."""
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.45, DENSITY), device="cpu")
    body.fix(nodes)
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=2.0), gravity=GRAVITY)
    largest = 0.0
    for _ in range(round(40 * seconds)):
        sim.advance(0.025)
        largest = max(largest, float(np.linalg.norm(body.displacements.numpy(), axis=1).max()))
    return largest / float(np.ptp(mesh.points[:, 2]))


@pytest.mark.parametrize("shape", [kidney, gall_bladder, liver])
def test_organs_do_not_topple(shape):
    """For the time in which they topple if their lowest tip is fixed."""
    mesh = shaped(shape)
    chosen = held(mesh)
    young = soft(mesh) * chosen.stiffer
    assert largest_displacement(mesh, chosen.nodes, young, 0.5) < 0.7
    if not chosen.pieces[0].stands:
        assert chosen.nodes.sum() >= 0.1 * len(mesh.points)
        assert "lowest 10 %" in chosen.reasons()[0]


def test_a_patch_that_is_not_chosen_lets_the_body_topple():
    """The estimate is needed: a pear fixed at its lower tip does topple."""
    mesh = shaped(gall_bladder)
    tip = mesh.points[:, 2] < mesh.points[:, 2].min() + 0.1 * np.ptp(mesh.points[:, 2])
    assert not held(mesh).pieces[0].stands
    assert largest_displacement(mesh, tip, soft(mesh), 0.5) > 1.0


@pytest.mark.parametrize(
    ("shape", "lies"),
    [
        (trimesh.creation.icosphere(3), "it has no flat feet"),
        (trimesh.creation.capsule(2.0, 1.0), "it has no flat feet"),
        (trimesh.creation.torus(1.0, 0.3), ""),
        (trimesh.creation.cylinder(1.0, 2.0), ""),
        (trimesh.creation.box((0.1, 0.1, 2.0)), "it would topple on its lowest 10 %"),
    ],
    ids=["ball", "capsule", "ring", "drum", "reed"],
)
def test_a_body_without_flat_feet_may_lie(shape, lies):
    shape = shape.copy().apply_scale(0.05)
    domain = wc.Domain.from_surface((shape.vertices, shape.faces), up_axis="Z", device="cpu")
    mesh = wc.TetForest.from_domain(domain, target_elements=800, device="cpu")
    given = {"young": soft(mesh), "density": DENSITY, "surface": mesh.surface()}
    found = supports_of(mesh, gravity=GRAVITY, may_lie=True, **given)
    assert found.lies == lies
    assert found.nodes.any() == (not lies)
    for other in ({"gravity": GRAVITY}, {"gravity": (0, 0, 0), "may_lie": True}):
        assert supports_of(mesh, **given, **other).nodes.any()


def test_a_standing_body_stays_standing():
    cube = wc.TetForest.box((2, 2, 2), 0.05, 3)
    (hold,) = held(cube).pieces
    assert hold.stands
    np.testing.assert_array_equal(np.sort(hold.nodes), np.flatnonzero(cube.points[:, 2] == 0.0))


def test_a_slender_column_stands_only_if_it_is_stiff():
    """Greenhill: it buckles under its weight where E < q L^3 / (7.84 I)."""
    cells, edge = (1, 1, 12), 0.02
    column = wc.TetMesh(wc.TetForest.box(cells, edge, 6).points, wc.TetForest.box(cells, edge, 6).tets, up_axis="Z")
    length = cells[2] * edge
    critical = DENSITY * 9.81 * edge**2 * length**3 / (7.84 * edge**4 / 12.0)
    assert not held(column, critical).pieces[0].stands
    assert held(column, 4.0 * critical).pieces[0].stands


def test_it_stands_only_with_its_centre_of_mass_over_the_patch():
    """An inverted L with a long arm; stiff, so that only balance matters."""
    box = wc.TetForest.box((4, 1, 3), 0.1, 3)
    centroids = box.points[box.tets].mean(axis=1)
    kept = (centroids[:, 2] > 0.2) | (centroids[:, 0] < 0.1)
    used, tets = np.unique(box.tets[kept], return_inverse=True)
    mesh = wc.TetMesh(box.points[used], tets.reshape(-1, 4), up_axis="Z")
    (hold,) = held(mesh, 1e9).pieces
    assert not hold.stands
    assert "centre of mass is not over" in hold.why_not
    assert hold.stiffer == 1.0


def test_each_piece_is_held():
    """Even one that meets another in only one node, about which it would swing."""
    one = shaped(functools.partial(np.multiply, 0.05), level=3)
    top = int(np.argmax(one.points[:, 2]))
    shift = one.points[top] - one.points[np.argmin(one.points[:, 2])]
    count = len(one.points)
    other = one.tets + count
    other[other == count + int(np.argmin(one.points[:, 2]))] = top
    mesh = wc.TetMesh(np.concatenate([one.points, one.points + shift]), np.concatenate([one.tets, other]), up_axis="Z")
    assert np.bincount(pieces_of(mesh.tets)).tolist() == 2 * [len(one.tets)]
    chosen = held(mesh, 1e6)
    assert len(chosen.pieces) == 2
    lower, upper = chosen.nodes[:count], chosen.nodes[count:]
    assert lower.any()
    assert upper.any()
    assert len(chosen.reasons()) == 2


@pytest.mark.parametrize("kind", [CoarseBody, MeshBody])
def test_sag_is_that_of_a_beam(kind):
    """Timoshenko's cantilever: bending by q L^4 / 8 E I, and shear by q L^2 / 2 k G A."""
    mesh = wc.TetForest.box((8, 1, 1), 0.1, 9)
    young, length, edge = 1e6, 0.8, 0.1
    load = DENSITY * 9.81 * edge**2
    shear_modulus = young / 2.6
    expected = load * length**4 / (8 * young * edge**4 / 12) + load * length**2 / (2 * 5 / 6 * shear_modulus * edge**2)
    body = kind(mesh.points, mesh.tets, mesh.volumes, young, DENSITY)
    ends = np.flatnonzero(mesh.points[:, 0] == 0.0)
    down, along = body.sag(ends, [GRAVITY, [9.81, 0.0, 0.0]])
    assert down.largest == pytest.approx(expected, rel=0.1)
    assert along.largest == pytest.approx(DENSITY * 9.81 * length**2 / (2 * young), rel=0.1)
    assert body.centre == pytest.approx([0.4, 0.05, 0.05], abs=1e-3)


def hairpin():
    """Two arms of 40 cm with a slit of 12.5 mm, joined at one end; returns nodes at the other end of the upper one."""
    box = wc.TetForest.box((4, 1, 2), 0.1, 9)
    middle = box.points[box.tets].mean(axis=1)
    kept = (np.abs(middle[:, 2] - 0.1) > 0.00625) | (middle[:, 0] > 0.3)
    used, tets = np.unique(box.tets[kept], return_inverse=True)
    mesh = wc.TetMesh(box.points[used], tets.reshape(-1, 4), up_axis="Z")
    return mesh, np.flatnonzero((mesh.points[:, 0] == 0.0) & (mesh.points[:, 2] > 0.1))


def test_arms_next_to_one_another_are_not_one():
    """Linear dynamics comes to rest at the estimated place."""
    mesh, nodes = hairpin()
    own = MeshBody(mesh.points, mesh.tets, mesh.volumes, 1e6, DENSITY).sag(nodes, [GRAVITY])[0].largest
    body = wc.SoftBody(mesh, wc.Isotropic(1e6, 0.3, DENSITY), device="cpu")
    body.fix(nodes)
    sim = wc.Simulation(body, model=wc.Linear(), integrator=wc.SymplecticEuler(damping=30.0), gravity=GRAVITY)
    sim.advance(1.5)
    settled = np.linalg.norm(body.displacements.numpy(), axis=1).max()
    assert own == pytest.approx(settled, rel=0.03)


def test_a_dangling_crumb_does_not_count():
    """A nearly empty tetrahedron on a face."""
    cube = wc.TetForest.box((1, 1, 1), 0.1, 6)
    held = np.flatnonzero(cube.points[:, 2] == 0.0)
    base = cube.tets[np.argmax(cube.points[cube.tets].mean(axis=1)[:, 2])]
    top = base[np.argsort(cube.points[base][:, 2])[1:]]
    points = np.concatenate([cube.points, np.add(cube.points[top].mean(axis=0), [[0.0, 0.0, 0.01]])])
    tets = np.concatenate([cube.tets, [[*top, len(cube.points)]]])
    volumes = np.concatenate([cube.volumes, [1e-3 * cube.volumes.min()]])
    young = np.concatenate([np.full(len(cube.tets), 1e5), [1e-3]])
    with_crumb = MeshBody(points, tets, volumes, young, DENSITY).sag(held, [GRAVITY])[0].largest
    alone = MeshBody(cube.points, cube.tets, cube.volumes, 1e5, DENSITY).sag(held, [GRAVITY])[0].largest
    assert with_crumb == pytest.approx(alone, rel=1e-3)


def test_the_largest_flat_region_is_found():
    """A bowl that is filled to the brim."""
    mesh = shaped(lambda x: x * [0.05, 0.05, 0.04] * np.where(x[:, 2:] > 0.0, [1.0, 1.0, 0.1], 1.0))
    faces = boundary_faces(mesh.tets, mesh.points)[0]
    shape = BodyShape(mesh.points, np.arange(len(mesh.points)), mesh.points, faces, np.array([0.0, 0.0, 1.0]))
    patch = flat_region(shape)
    assert patch.where.endswith("facing up")
    assert mesh.points[patch.nodes, 2].min() > -0.02
    assert len(patch.nodes) >= 0.1 * len(mesh.points)


def test_a_sheet_thinner_than_its_elements_is_held_to_its_corners():
    """The nodes next to its flat side are a layer, and the whole layer is fixed."""
    sheet = trimesh.creation.box((0.2, 0.2, 0.002))
    domain = wc.Domain.from_surface((sheet.vertices, sheet.faces), up_axis="Z")
    forest = wc.TetForest.from_domain(domain, target_elements=5000)
    surface = forest.surface()
    chosen = supports_of(forest, young=1e3, density=DENSITY, gravity=GRAVITY, surface=surface)
    assert "flat region" in chosen.words
    around = np.unique(surface.nodes[surface.points[:, 2] > 0.0009])
    off = np.abs(forest.points[around, 2] - 0.001)
    assert chosen.nodes[around[off < off.min() + 1e-6]].all()
    assert not chosen.nodes.all()


def test_a_thin_sheet_and_a_single_tetrahedron_keep_free_nodes():
    sheet = wc.TetForest.box((8, 8, 1), 0.01, 0)
    leaf = wc.TetMesh(sheet.points * [1.0, 1.0, 0.2], sheet.tets, up_axis="Z")
    on_edge = wc.TetMesh(leaf.points[:, [2, 0, 1]], leaf.tets, up_axis="Z")
    tetrahedron = wc.TetMesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 1, 2, 3]], up_axis="Z")
    for mesh in (leaf, on_edge, tetrahedron):
        nodes = held(mesh).nodes
        assert nodes.any()
        assert not nodes.all()


def test_loose_tetrahedra_are_held_each_and_all_move():
    """Even if they share nodes."""
    corner = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
    points = np.concatenate([corner, np.add(corner[1:], [1.0, 0.0, 0.0]), -corner[1:]])
    mesh = wc.TetMesh(points, [[0, 1, 2, 3], [0, 4, 5, 6], [0, 8, 7, 9]], up_axis="Z")
    chosen = held(mesh)
    for tet in mesh.tets:
        assert chosen.nodes[tet].sum() >= 3
    assert not chosen.nodes.all()


def test_an_asset_softer_than_it_is_meant_to_be_is_held_by_what_carries_it():
    from argparse import Namespace

    from warp_corot.cli.input_mesh import InputMesh
    from warp_corot.io.read.meshes import find_asset

    mesh = wc.TetForest.box((1, 1, 1), 0.1, 0)
    for young, fix in ((None, "y < 0.01"), (3e4, "y < 0.01"), (3e3, None)):
        subject = InputMesh(mesh, "bunny")
        subject.take(find_asset("warp:bunny"), Namespace(young=young, unit=None, scale=None, offset=None))
        assert subject.fix == fix
        assert subject.young == 3e4
