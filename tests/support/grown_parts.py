"""Meshes that ranks grow in parts, compared with the whole."""

from pathlib import Path

import numpy as np

import warp_corot as wc
from warp_corot.distributed import mpi
from warp_corot.mesh.topology import boundary_faces


def blobs() -> wc.Domain:
    """Balls of many sizes, some smaller than an element and some that overlap: elements are given up, connect what
    would break apart, or hang from others by a node."""
    rng = np.random.default_rng(7)
    centres, radii = rng.uniform(-0.9, 0.9, (60, 3)) * [1.0, 0.6, 0.6], rng.uniform(0.01, 0.12, 60)

    def phi(x: np.ndarray) -> np.ndarray:
        found: np.ndarray = (np.linalg.norm(x[:, None] - centres, axis=2) - radii).min(axis=1)
        return found

    return wc.Domain.from_function(phi, [[-1.0, -0.6, -0.6], [1.0, 0.6, 0.6]], device="cpu")


def layers() -> wc.Domain:
    """A ball of voxels in four labels: two halves, a thin layer between them, and a single voxel that is smaller than
    an element."""
    x, y, z = np.indices((24, 20, 20)) - np.array([11.5, 9.5, 9.5])[:, None, None, None]
    numbers = np.where(z > 0.0, 1, 2).astype(np.int16)
    numbers[np.abs(z + 0.3 * x) < 0.6] = 3
    numbers[20, 10, 10] = 4
    numbers[x**2 / 1.4 + y**2 + z**2 > 80.0] = 0
    return wc.Domain.from_labels(numbers, spacing=(0.01, 0.01, 0.01), device="cpu")


def assert_whole(domain: wc.Domain, cell_size: float, **options: float) -> None:
    """All ranks have the parts of the mesh that one process makes: the same bits, and all elements around the nodes
    that they move."""
    import warp_corot.distributed as wd

    part, whole = (make(domain, cell_size, **options) for make in (wd.from_domain, wc.TetForest.from_domain))
    numbers, everybody = part.numbers, mpi.world()
    assert (part.element_count, numbers.node_count) == (len(whole.tets), len(whole.points))
    assert part.smallest_volume == whole.volumes.min()
    np.testing.assert_array_equal(part.bounds, [whole.points.min(axis=0), whole.points.max(axis=0)])
    np.testing.assert_array_equal(numbers.nodes[part.tets], whole.tets[numbers.elements])
    np.testing.assert_array_equal(part.points, whole.points[numbers.nodes])
    np.testing.assert_array_equal(part.fill, whole.fill[numbers.elements])
    assert part.label_names == whole.label_names
    if whole.labels is not None:
        np.testing.assert_array_equal(part.labels, whole.labels[numbers.elements])
    own = numbers.nodes[numbers.owner == everybody.rank]
    for mine, count in ((own, numbers.node_count), (numbers.elements[numbers.counted], part.element_count)):
        np.testing.assert_array_equal(np.sort(np.concatenate(everybody.allgather(mine))), np.arange(count))
    assert np.isin(np.flatnonzero(np.isin(whole.tets, own).any(axis=1)), numbers.elements).all()
    # Faces around a rank's nodes are on the surface of its part if they are on that of the whole.
    outer, here = (boundary_faces(tets)[0] for tets in (whole.tets, part.tets))
    outer, here = (np.sort(each, axis=1).tolist() for each in (outer, numbers.nodes[here]))
    around = [{tuple(each) for each in faces if np.isin(each, own).any()} for faces in (outer, here)]
    assert around[0] == around[1]


def assert_moves_as_whole(kept: Path) -> None:
    """A body of several materials grown in parts, whose elements share their dilatation, moves as the whole one on the
    same ranks, bit by bit; from a checkpoint, too."""
    import warp_corot.distributed as wd

    domain, found = layers(), []
    young = np.array([0.0, 3e3, 5e3, 2e4, 1e3])
    for make in (wd.from_domain, wc.TetForest.from_domain):
        mesh = make(domain, 0.06, max_level=4)
        assert mesh.labels is not None
        body = wc.SoftBody(mesh, wc.Isotropic(young[mesh.labels], 0.49, 1000.0), device="cpu")
        body.fix("z < zmin + 0.02")
        sim = wd.Simulation(body, deterministic=True)
        sim.advance(0.02)
        if make is wd.from_domain:
            sim.save(kept)
        sim.advance(0.01)
        found.append(wd.gather(body.positions))
    resumed = wd.Simulation.load(kept)
    resumed.advance(0.01)
    found.append(wd.gather(resumed.bodies[0].positions))
    if sim.rank == 0:
        assert np.abs(found[1] - body.mesh.points).max() > 1e-3
        np.testing.assert_array_equal(found[0], found[1])
        np.testing.assert_array_equal(found[2], found[1])


def assert_refuses() -> None:
    """Every rank says what is wrong, in one line."""
    import warp_corot.distributed as wd

    ball = wc.Domain.sphere(0.05, device="cpu")
    for domain, size, options, said in (
        (ball, 0.2, {"max_level": 3}, "take fewer ranks"),
        (ball, 0.03, {"max_level": -1}, "max_level is -1"),
        (ball, 0.003, {"max_level": 48}, "must be less in parts"),
        ("ball", 0.03, {}, "must be a Domain"),
    ):
        found = ""
        try:
            wd.from_domain(domain, size, **options)
        except wc.InputError as error:
            found = str(error)
        assert said in found, (said, found)
