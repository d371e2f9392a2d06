"""Signed functions of bodies: against closed forms, set theory and the laws that meshing relies on."""

import numpy as np
import pytest
import trimesh
import warp as wp
from domains import ROUNDING, around, arrays, with_hole

from warp_corot.domain import Domain
from warp_corot.errors import InputError


def directions(rng, count: int) -> np.ndarray:
    d = rng.standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@wp.func
def wavy(p: wp.vec3):
    return wp.length(p) - 0.8 - 0.1 * wp.sin(4.0 * p[0])


def wavy_numpy(p):
    return np.linalg.norm(p, axis=1) - 0.8 - 0.1 * np.sin(4.0 * p[:, 0])


KINDS = {
    "sphere": lambda device: Domain.sphere(0.7, (0.1, 0.2, -0.3), device=device),
    "box": lambda device: Domain.box((-0.5, -1.0, 0.0), (0.5, 0.2, 0.3), device=device),
    "torus": lambda device: Domain.torus(0.8, 0.3, (0.0, 0.1, 0.0), axis="X", device=device),
    "capsule": lambda device: Domain.capsule((0, 0, 0), (0.5, 0.5, 1.0), 0.2, device=device),
    "numpy function": lambda device: Domain.from_function(wavy_numpy, [[-0.7] * 3, [1.0] * 3], 1.4, device=device),
    "device function": lambda device: Domain.from_function(wavy, [[-0.7] * 3, [1.0] * 3], 1.4, device=device),
    "surface": lambda device: Domain.from_surface(arrays(trimesh.creation.torus(0.8, 0.3, 20, 9)), device=device),
    "open surface": lambda device: Domain.from_surface(with_hole(), device=device),
    "union": lambda device: Domain.sphere(0.7, device=device) | Domain.box((0, 0, 0), (1, 1, 1), device=device),
    "intersection": lambda device: Domain.sphere(0.7, device=device) & Domain.box((0, 0, 0), (1, 1, 1), device=device),
    "difference": lambda device: Domain.sphere(0.7, device=device) - Domain.box((0, 0, 0), (1, 1, 1), device=device),
}


@pytest.mark.filterwarnings("ignore:the surface is open")
@pytest.mark.parametrize("kind", KINDS)
def test_phi_keeps_its_lipschitz_constant_and_bounds(kind, device, rng):
    domain = KINDS[kind](device)
    a = around(domain, rng)
    b = a + directions(rng, len(a)) * 10.0 ** rng.uniform(-4, 0, (len(a), 1))
    change = np.abs(domain.phi(a) - domain.phi(b))
    assert (change <= domain.lipschitz * np.linalg.norm(a - b, axis=1) + ROUNDING).all()
    inside = domain.phi(a) < -ROUNDING
    assert inside.any()
    assert ((a[inside] >= domain.bounds[0]) & (a[inside] <= domain.bounds[1])).all()


@pytest.mark.parametrize("kind", ["sphere", "surface", "device function", "difference"])
def test_warp_arrays_are_evaluated_on_their_device(kind, device, rng):
    domain = KINDS[kind]("cpu")
    points = around(domain, rng).astype(np.float32)
    there = domain.phi(wp.array(points, dtype=wp.vec3, device=device))
    assert there.device == wp.get_device(device)
    assert np.allclose(there.numpy(), domain.phi(points), atol=ROUNDING)


def test_shapes_along_their_normals(device, rng):
    """At x = s + t n, with n the normal at a point s of the surface, phi is t up to the shape's reach."""
    n = directions(rng, 500)
    t = rng.uniform(-0.2, 1.0, (500, 1))
    centre = np.array([0.3, -0.2, 0.1])
    assert np.allclose(Domain.sphere(0.5, centre, device=device).phi(centre + (0.5 + t) * n), t[:, 0], atol=ROUNDING)

    angle = rng.uniform(0, 2 * np.pi, 500)
    ring = np.stack([np.zeros(500), np.cos(angle), np.sin(angle)], axis=1)
    tube = np.sign(rng.standard_normal((500, 1))) * np.eye(3)[0] * np.sqrt(0.5) + ring * np.sqrt(0.5)
    torus = Domain.torus(0.8, 0.25, centre, axis="X", device=device)
    assert np.allclose(torus.phi(centre + 0.8 * ring + (0.25 + t) * tube), t[:, 0], atol=ROUNDING)

    start, end = np.array([0.1, 0.0, 0.2]), np.array([0.5, 1.0, -0.3])
    along = end - start
    across = np.cross(n, along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    middle = start + rng.random((500, 1)) * along
    capsule = Domain.capsule(start, end, 0.25, device=device)
    assert np.allclose(capsule.phi(middle + (0.25 + t) * across), t[:, 0], atol=ROUNDING)
    cap = n * np.where(n @ along > 0, 1.0, -1.0)[:, None]
    assert np.allclose(capsule.phi(end + (0.25 + t) * cap), t[:, 0], atol=ROUNDING)

    low, high = np.array([-0.5, -1.0, 0.0]), np.array([0.5, 0.2, 0.6])
    box = Domain.box(low, high, device=device)
    outward = np.abs(n)
    assert np.allclose(box.phi(high + np.abs(t) * outward), np.abs(t[:, 0]), atol=ROUNDING)
    face = low + rng.uniform(0.4, 0.6, (500, 3)) * (high - low)
    face[:, 0] = high[0]
    assert np.allclose(box.phi(face + t * np.eye(3)[0]), t[:, 0], atol=ROUNDING)


def test_sets_agree_with_set_theory(device, rng):
    a, b = Domain.sphere(0.7, device=device), Domain.torus(0.6, 0.3, device=device)
    points = around(a | b, rng)
    in_a, in_b = a.phi(points) < 0, b.phi(points) < 0
    assert np.array_equal((a | b).phi(points) < 0, in_a | in_b)
    assert np.array_equal((a & b).phi(points) < 0, in_a & in_b)
    assert np.array_equal((a - b).phi(points) < 0, in_a & ~in_b)
    with pytest.raises(InputError, match="do not meet"):
        a & Domain.sphere(0.1, (5, 0, 0))


def test_labels_of_sets(device, rng):
    liver, tumour = Domain.sphere(1.0, device=device).named("liver"), Domain.sphere(0.4, (0.8, 0, 0), device=device)
    both = tumour.named("tumour") | liver
    points = around(both, rng)
    in_liver, in_tumour = liver.phi(points) < 0, tumour.phi(points) < 0
    expected = np.where(in_tumour, 1, np.where(in_liver, 2, 0))
    assert both.label_names == ("tumour", "liver")
    assert np.array_equal(both.labels_at(points), expected)
    assert (both.labels_at(points, nearest=True) > 0).all()
    for place, name in enumerate(both.label_names, start=1):
        assert np.array_equal(both.part(name).phi(points) < 0, expected == place)
    cut = both - Domain.box((-2, -2, -2), (2, 2, 0), device=device)
    assert np.array_equal(cut.labels_at(points), np.where(points[:, 2] > 0, expected, 0))
    assert np.array_equal(cut.part("liver").phi(points) < 0, (expected == 2) & (points[:, 2] > 0))
    # Where they meet, a body without labels keeps the other's label, and has none elsewhere.
    plain = tumour | liver
    assert np.array_equal(plain.labels_at(points), np.where(in_liver, 1, 0))
    with pytest.raises(InputError, match=r"no label 'spleen'.*tumour, liver"):
        both.part("spleen")


def test_functions_of_numpy_and_of_warp_agree_and_end_at_the_bounds(device, rng):
    bounds = np.array([[-0.7] * 3, [1.0] * 3])
    domains = [Domain.from_function(f, bounds, 1.4, device=device) for f in (wavy, wavy_numpy)]
    points = rng.uniform(-0.7, 1.0, (2000, 3))
    assert np.allclose(domains[0].phi(points), domains[1].phi(points), atol=ROUNDING)
    deep = (points > -0.4).all(axis=1) & (points < 0.7).all(axis=1)
    assert np.allclose(domains[0].phi(points)[deep], wavy_numpy(points)[deep], atol=ROUNDING)
    assert (domains[0].phi([[-0.75, 0, 0], [0, -0.71, 0]]) > 0).all()
    assert any("cut off" in line for line in domains[0].report())


def test_bad_arguments_are_refused_in_one_line(tmp_path):
    box = [[-1.0] * 3, [1.0] * 3]
    for make, message in [
        (lambda: Domain.sphere(-1.0), "radius is -1.0"),
        (lambda: Domain.sphere(np.nan), "radius is nan"),
        (lambda: Domain.box((0, 0, 0), (1, 0, 1)), "is empty"),
        (lambda: Domain.torus(0.3, 0.5), "minor must be smaller"),
        (lambda: Domain.torus(0.5, 0.3, axis="z"), "axis is 'z'"),
        (lambda: Domain.capsule((0, 0, 0), (0, 0, 0), 1.0), "ends must differ"),
        (lambda: Domain.sphere(1.0, up_axis="up"), "up_axis is 'up'"),
        (lambda: Domain.sphere(1.0, device="cuda:99"), "no device 'cuda:99'"),
        (lambda: Domain.from_function(lambda x: 3.0 * x[:, 0], box), "changes by 3 m per metre; lipschitz is 1"),
        (lambda: Domain.from_function(lambda x: x[:, 0] * np.nan, box), "must be finite"),
        (lambda: Domain.from_function(lambda x: x, box), r"shape \(4096, 3\)"),
        (lambda: Domain.from_function(lambda x: x[:, 0], box[::-1]), "bounds are"),
        (lambda: Domain.from_function(lambda x: x[:, 0], box, lipschitz=0.0), "lipschitz is 0.0"),
        (lambda: Domain.sphere(1.0).phi([1.0, 2.0, 3.0]), r"shape \(3,\)"),
        (lambda: Domain.sphere(1.0).phi([[1.0, np.nan, 3.0]]), "point 0 is"),
        (lambda: Domain.sphere(1.0).named(""), "label name"),
        (lambda: Domain.from_surface(tmp_path), "is a folder"),
        (lambda: Domain.from_surface(tmp_path / "none.obj"), "no such file"),
        (lambda: Domain.from_surface(__file__), "unknown format .py"),
    ]:
        with pytest.raises(InputError, match=message) as raised:
            make()
        assert "\n" not in str(raised.value)


def test_domains_have_the_attributes_of_their_kind():
    """A domain of voxels has their numbers and positions, one of a surface the closed surface."""
    voxels = Domain.from_labels(np.ones((2, 3, 4), np.int16), (0.01, 0.01, 0.01), device="cpu")
    assert np.count_nonzero(voxels.numbers) == 24
    assert np.allclose(voxels.affine[:3, :3], 0.01 * np.eye(3))
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    tetrahedron = Domain.from_surface((corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), device="cpu")
    assert tetrahedron.closed.volume == pytest.approx(1 / 6)
    assert all(isinstance(each, Domain) for each in (voxels, tetrahedron, voxels | tetrahedron, voxels.part("1")))
    with pytest.raises(AttributeError, match="numbers"):
        _ = tetrahedron.numbers
