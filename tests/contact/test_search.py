"""The search finds nodes and triangles before they meet, whenever it last ran."""

import numpy as np
import pytest

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
CALM = wc.SymplecticEuler(viscosity=1e-3)


def block(device, z, cells=(2, 2, 1), at=0.0, **options):
    mesh = wc.TetForest.box(cells=cells, cell_size=0.02, level=options.pop("level", 2), origin=(at, at, z))
    return wc.SoftBody(mesh, SOFT, device=device, **options)


def closest(p, a, b, c):
    """Distances [n] of points from triangles: to their insides or to their edges."""
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = ((p - a) * normal).sum(axis=1)
    foot = p - height[:, None] * normal
    inside = np.ones(len(p), bool)
    least = np.full(len(p), np.inf)
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(v - u, foot - u) * normal).sum(axis=1) >= 0.0
        share = np.clip(((p - u) * (v - u)).sum(axis=1) / ((v - u) ** 2).sum(axis=1), 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(p - u - share[:, None] * (v - u), axis=1))
    return np.where(inside, np.abs(height), least)


def face_each_other(s, t, x, corners, body):
    """Whether a node of one body and a triangle of another face each other: one of the faces around the node faces the
    triangle within 60 degrees, or all of them together do."""
    a, b, c = (x[corners[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    out, least = np.zeros_like(x), np.ones(len(s))
    for face in np.flatnonzero(corners[:, 0] >= 0):
        for corner in corners[face]:
            out[corner] += normals[face]
            at = s == corner
            least[at] = np.minimum(least[at], normals[t[at]] @ normals[face])
    together = (out[s] * normals[t]).sum(axis=1) / np.maximum(np.linalg.norm(out[s], axis=1), 1e-30)
    return (body[s] == body[corners[t, 0]]) | (np.minimum(least, together) < -0.5)


def within_reach(contacts, itself):
    """All nodes and triangles that could meet in the last step, tested one by one: [n, 2]."""
    surface = contacts.surface
    arrays, corners = surface.arrays, surface.triangles.numpy()
    node, world, body = arrays.node.numpy(), arrays.world.numpy(), surface.body_of_places()
    x, step = arrays.x.numpy().astype(float), np.linalg.norm(arrays.d.numpy().astype(float), axis=1)
    s, t = (each.ravel() for each in np.meshgrid(np.flatnonzero(node >= 0), np.flatnonzero(corners[:, 0] >= 0)))
    c = corners[t]
    may = (c != s[:, None]).all(axis=1) & (world[s] == world[c[:, 0]])
    may &= itself | (body[s] != body[c[:, 0]])
    # A node does not meet the face opposite to it in its own tetrahedron.
    may &= surface.opposite.numpy()[t] != s
    s, t, c = s[may], t[may], c[may]
    far = closest(x[s], x[c[:, 0]], x[c[:, 1]], x[c[:, 2]])
    near = far <= step[s] + step[c].max(axis=1)
    s, t = s[near], t[near]
    return np.column_stack([s, t])[face_each_other(s, t, x, corners, body)]


def candidates(contacts):
    rows = contacts.pairs.rows
    count = int(rows.total.numpy()[0])
    owner, other = rows.owner.numpy()[:count], rows.other.numpy()[:count]
    return set(zip(owner.tolist(), other.tolist(), strict=True))


def watched(sim, steps, itself):
    """Make steps one at a time and check the pairs after each; returns how many pairs were within reach."""
    seen = 0
    for _ in range(steps):
        sim.advance_steps(1)
        pairs = within_reach(sim.contact, itself)
        seen += len(pairs)
        assert set(map(tuple, pairs.tolist())) <= candidates(sim.contact)
    assert sim.contact.search.count < steps
    return seen


@pytest.mark.parametrize("itself", [False, True])
def test_the_search_finds_all_pairs_within_reach(device, rng, itself, monkeypatch):
    """Compared with every pair, while two blocks in two worlds are thrown at one another, turn and bounce; the trees of
    boxes are built again at every other step."""
    monkeypatch.setattr("warp_corot.contact.search.REBUILT", 2)
    low, high = block(device, 0.0, worlds=2), block(device, 0.0202, cells=(1, 1, 1), at=0.008, worlds=2)
    sim = wc.Simulation([low, high], contact=wc.Contact(self_contact=itself), gravity=(0.0, 0.0, 0.0), integrator=CALM)
    for body, toward in ((low, 0.5), (high, -1.0)):
        x = body.positions.numpy()
        spin = rng.uniform(-20.0, 20.0, 3)
        centre = x.mean(axis=0)
        body.velocities = np.cross(spin, x - centre) + np.array([0.0, 0.0, toward]) + rng.uniform(-0.05, 0.05, x.shape)
    assert watched(sim, 60, itself) > 50


def test_the_search_finds_all_pairs_of_remeshed_bodies(device):
    low, high = block(device, 0.0, level=3), block(device, 0.0202, level=3)
    sim = wc.Simulation(
        [low, high],
        contact=wc.Contact(),
        gravity=(0.0, 0.0, 0.0),
        remesh=wc.OnlineRemesh(every=16, max_level=5, refine_above=1.01, simplify_below=1.002),
    )
    before = len(low.mesh.tets)
    high.velocities = np.tile((0.0, 0.0, -1.0), (high.node_count, 1))
    assert watched(sim, 40, False) > 50
    assert len(low.mesh.tets) != before


def test_neighbours_on_a_curved_surface_are_no_pairs(device, rng):
    """They face the same way, so a ball has hardly any pairs with itself while it is shaken."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), target_elements=800)
    ball = wc.SoftBody(mesh, SOFT, device=device)
    sim = wc.Simulation(ball, contact=wc.Contact(self_contact=True), gravity=(0.0, 0.0, 0.0))
    ball.velocities = rng.normal(scale=0.2, size=mesh.points.shape)
    sim.advance_steps(20)
    assert sim.contact.search.count > 2
    assert len(candidates(sim.contact)) < 0.05 * sim.contact.surface.count


def thrown(device, least, **sizes):
    """Final positions of two blocks that were thrown at one another, and the search for pairs."""
    low, high = block(device, 0.0), block(device, 0.0205, cells=(1, 1, 1), at=0.008)
    integrator = wc.SymplecticEuler(dt=2e-4, viscosity=1e-3)
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=(0.0, 0.0, 0.0), integrator=integrator)
    low.fix("z == zmin")
    high.velocities = np.tile((0.2, 0.1, -0.5), (high.node_count, 1))
    search = sim.contact.search
    # Steps look at all pairs within this distance.
    sim.contact.law.closing = sizes.get("closing", sim.contact.law.closing)
    search.watch.least.fill_(least)
    search.watch.size = sizes.get("size", search.watch.size)
    search.farthest = sizes.get("most", search.farthest)
    sim.advance(0.02)
    return high.positions.numpy(), search


def test_the_times_of_searches_do_not_matter():
    """On the CPU, where pairs are added up in one order, runs with many and with few searches are the same bit for
    bit."""
    found = [thrown("cpu", least) for least in (2e-4, 8e-3)]
    counts = [search.count for _, search in found]
    assert counts[0] > counts[1]
    np.testing.assert_array_equal(found[0][0], found[1][0])


def test_motion_beyond_the_margin_repeats_the_run():
    """If too little room was reserved, the run is repeated with more, with the same result as if there had been
    enough."""
    enough, _ = thrown("cpu", 2e-4, closing=1e-9)
    again, search = thrown("cpu", 1e-6, size=1e-9, closing=1e-9)
    assert float(search.watch.least.numpy()[0]) > 1e-5
    assert not search.has_missed
    np.testing.assert_array_equal(again, enough)


def test_the_search_reaches_no_farther_than_steps_can_go(device):
    with pytest.raises(wc.UnstableError, match="in one step"):
        thrown(device, 1e-6, size=1e-9, most=1e-7, closing=1e-9)


def marked(contacts):
    """The nodes and the triangles that the search has marked as near the first obstacle, or that a step has visited."""
    near = contacts.search.near if contacts.approach is None else contacts.approach.here
    nodes = near.nodes.numpy()[: int(near.count.numpy()[0])]
    beside = nodes[near.flags.numpy()[nodes] & 2 != 0]
    touches = near.touches.numpy()[: int(near.touch_count.numpy()[0])]
    first = touches[touches < contacts.surface.triangle_count]
    return set(beside.tolist()), set(first.tolist())


def reached_by_ball(contacts, radius):
    """The nodes and the triangles that a ball could meet in the last step, tested one by one."""
    surface, motions = contacts.surface, contacts.obstacles.motions
    arrays, corners = surface.arrays, surface.triangles.numpy()
    used, world = np.flatnonzero(arrays.node.numpy() >= 0), arrays.world.numpy()
    x, step = arrays.x.numpy().astype(float), np.linalg.norm(arrays.d.numpy().astype(float), axis=1)
    centre, later = (poses.numpy()[:, 0, :3].astype(float) for poses in (motions.now, motions.later))
    moved = np.linalg.norm(later - centre, axis=1)
    gaps = np.linalg.norm(x - centre[world], axis=1) - radius
    nodes = used[gaps[used] <= step[used] + moved[world[used]]]
    shown = np.flatnonzero(corners[:, 0] >= 0)
    c = corners[shown]
    far = closest(centre[world[c[:, 0]]], x[c[:, 0]], x[c[:, 1]], x[c[:, 2]]) - radius
    return set(nodes.tolist()), set(shown[far <= step[c].max(axis=1) + moved[world[c[:, 0]]]].tolist())


@pytest.mark.parametrize("adapts", [False, True])
def test_the_search_finds_everything_within_a_tools_reach(device, rng, adapts):
    """Compared with every node and triangle, while a ball moves to and fro at random through two worlds, or over a
    remeshed body."""
    low = block(device, 0.0, level=3) if adapts else block(device, 0.0, worlds=2)
    low.fix("z == zmin")
    ball = wc.Tool(wc.Sphere(0.012))
    places = rng.uniform((0.0, 0.0, 0.024), (0.04, 0.04, 0.036), (12, 3))
    ball.follow(0.003 * np.arange(12), places)
    remesh = wc.OnlineRemesh(every=16, max_level=5, refine_above=1.02, simplify_below=1.005) if adapts else None
    sim = wc.Simulation(low, obstacles=[ball, wc.Ground()], gravity=(0.0, 0.0, 0.0), remesh=remesh)
    seen = np.zeros(2, int)
    steps = 60
    for _ in range(steps):
        sim.advance_steps(1)
        for k, (reached, known) in enumerate(
            zip(reached_by_ball(sim.contact, 0.012), marked(sim.contact), strict=True)
        ):
            assert reached <= known
            seen[k] += len(reached)
    assert seen.min() > 5
    if sim.contact.approach is None:
        assert sim.contact.search.count < 0.7 * steps


@pytest.mark.parametrize("shape", [wc.Box((0.01, 0.008, 0.006)), wc.Capsule(0.002, 0.02)], ids=["box", "capsule"])
def test_neither_the_times_of_searches_nor_visits_matter_to_tools(shape):
    """On the CPU the results are the same bit for bit, with searches and with visits to what may touch."""
    found = []
    for least, visits in ((1e-4, False), (1e-2, False), (1e-4, True)):
        body, tool = block("cpu", 0.0, level=3), wc.Tool(shape)
        tool.follow([0.0, 0.03], [(0.021, 0.02, 0.0325), (0.023, 0.019, 0.02)], [(0, 0, 0, 1), (0.3, 0, 0, 0.95)])
        sim = wc.Simulation(body, obstacles=[wc.Ground(), tool], integrator=wc.SymplecticEuler(dt=2e-4, viscosity=1e-3))
        if not visits:
            sim.contact.approach = None
        sim.contact.search.watch.least.fill_(least)
        sim.advance(0.03)
        found.append((sim.contact.search.count, body.positions.numpy(), tool.wrench.numpy()))
    assert found[0][0] > found[1][0]
    for _, positions, wrench in found[1:]:
        np.testing.assert_array_equal(positions, found[0][1])
        np.testing.assert_array_equal(wrench, found[0][2])
    assert found[0][2].any()
