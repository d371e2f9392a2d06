"""Label volumes: against closed forms, brute force, and the same volume in other placements."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from volumes import SPACING, affine_of, ball, blobs, turned

from warp_corot.domain import Domain, labels_from_probabilities
from warp_corot.domain.labels import signed_distance, steepest_slope
from warp_corot.errors import InputError

ROUNDING = 3e-6


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_flat_face_lies_halfway_between_voxel_centres(axis, device, rng):
    volume = np.zeros((12, 12, 12), int)
    volume[(slice(None),) * axis + (slice(0, 7),)] = 3
    volume = np.pad(volume, 20, mode="edge")  # far from the volume's ends, where the body is truncated
    domain = Domain.from_labels(volume, SPACING, origin=-20 * SPACING, device=device)
    points = SPACING * rng.uniform(3.0, 7.9, (500, 3))
    assert np.allclose(domain.phi(points), points[:, axis] - 6.5 * SPACING[axis], atol=ROUNDING)


def test_a_block_of_voxels_is_a_box_inside_and_straight_out_of_its_faces(device, rng):
    volume = np.zeros((20, 18, 16), bool)
    volume[4:15, 3:12, 5:11] = True
    domain = Domain.from_labels(volume, (0.01,) * 3, origin=(1.0, 2.0, 3.0), device=device)
    low, high = np.array([[3.5, 2.5, 4.5], [14.5, 11.5, 10.5]]) * 0.01 + [1, 2, 3]
    box = Domain.box(low, high, device=device)
    centres = np.argwhere(volume) * 0.01 + [1, 2, 3]
    assert np.allclose(domain.phi(centres), box.phi(centres), atol=ROUNDING)
    out = low + rng.uniform(0.2, 0.8, (300, 3)) * (high - low)
    axis = rng.integers(0, 3, 300)
    out[np.arange(300), axis] = high[axis] + rng.uniform(0.0, 0.015, 300)
    assert np.allclose(domain.phi(out), box.phi(out), atol=ROUNDING)
    assert (domain.bounds[0] <= low).all()
    assert (domain.bounds[1] >= high).all()
    assert (np.abs(domain.bounds - [low, high]) < 0.0100001).all()


def test_distances_are_exact(rng):
    """Against all pairs of voxels: the distance, less half of one of the n steps to the nearest voxel."""
    inside = rng.random((8, 7, 6)) < 0.3
    phi, nearest = signed_distance(inside, SPACING)
    index = np.argwhere(np.ones_like(inside))
    for voxel in index:
        others = np.argwhere(inside != inside[tuple(voxel)])
        distance = np.linalg.norm((others - voxel) * SPACING, axis=1)
        steps = np.abs(others - voxel)[np.isclose(distance, distance.min())].max(axis=1)
        possible = distance.min() * (1.0 - 0.5 / steps)
        assert np.isclose(np.abs(phi[tuple(voxel)]), possible, rtol=1e-5).any()
        assert (phi[tuple(voxel)] < 0) == inside[tuple(voxel)]
        assert inside[tuple(nearest[:, voxel[0], voxel[1], voxel[2]])]


def test_a_ball_converges_with_the_voxels(device, rng):
    """The volume within phi < 0 and the distance, as the voxels shrink."""
    points = rng.uniform(-0.28, 0.28, (20000, 3))
    exact = np.linalg.norm(points, axis=1) - 0.2
    errors = []
    for fine in (1, 2, 4):
        volume, origin = ball(0.2, SPACING / fine)
        domain = Domain.from_labels(volume, SPACING / fine, origin=origin, device=device)
        near = ((points > domain.bounds[0]) & (points < domain.bounds[1])).all(axis=1)
        error = np.abs(domain.phi(points) - exact)[near]
        # A centre on the other side is never farther from the sphere than the diagonal of a voxel.
        assert error.max() < np.linalg.norm(SPACING) / fine
        errors.append(error.mean())
        # Farther out it is a lower bound, within a factor of the root of two.
        phi, far = domain.phi(points)[~near], exact[~near]
        slack = np.linalg.norm(SPACING) / fine
        assert ((phi > np.sqrt(0.5) * far - slack) & (phi < far + slack)).all()
    assert errors[2] < 0.35 * errors[0]
    assert np.mean(domain.phi(points) < 0) == pytest.approx(np.mean(exact < 0), rel=0.02)


@pytest.mark.parametrize("how", ["straight", "turned", "sheared", "smoothed"])
def test_phi_keeps_its_lipschitz_constant_and_bounds(how, device, rng):
    directions = np.eye(3) if how == "straight" else turned(rng)
    if how == "sheared":
        directions = directions @ np.array([[1, 0.3, 0.1], [0, 0.9, 0.2], [0, 0, 1]])
    smoothing = 0.015 if how == "smoothed" else 0.0
    domain = Domain.from_labels(blobs(rng), affine=affine_of(directions), smoothing=smoothing, device=device)
    size = np.ptp(domain.bounds, axis=0)
    a = domain.bounds[0] - size + 3.0 * rng.random((20000, 3)) * size
    step = rng.standard_normal(a.shape)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    b = a + step * 10.0 ** rng.uniform(-4, 0, (len(a), 1)) * 0.3
    apart = np.linalg.norm(a - b, axis=1)
    change = np.abs(domain.phi(a) - domain.phi(b))
    assert (change <= domain.lipschitz * apart + ROUNDING).all()
    # The bound is close to the true value.
    far = apart > 1e-3
    assert (change / apart)[far].max() > 0.4 * domain.lipschitz
    inside = domain.phi(a) < 0
    assert inside.any()
    assert ((a[inside] >= domain.bounds[0]) & (a[inside] <= domain.bounds[1])).all()


def test_steepest_slope_of_a_linear_function_is_its_gradient(rng):
    """By hand: for a linear function the bound is the gradient's length, for one raised voxel the root of three."""
    gradient = rng.standard_normal(3)
    x = np.stack(np.meshgrid(*[np.arange(70) * s for s in SPACING], indexing="ij"), axis=-1)
    assert np.isclose(steepest_slope((x @ gradient).astype(np.float32), SPACING), np.linalg.norm(gradient), rtol=1e-3)
    raised = np.zeros((50, 5, 5), np.float32)
    raised[40, 2, 2] = 1.0
    assert np.isclose(steepest_slope(raised, np.ones(3)), np.sqrt(3.0))


def test_no_gradient_is_steeper_than_the_steepest_slope(rng):
    """Against SciPy's trilinear interpolation of noise, and of one raised voxel at every corner of a cell."""
    for place in (None, *np.ndindex(2, 2, 2)):
        values = np.zeros((2, 2, 2)) if place else rng.standard_normal((5, 4, 4))
        if place:
            values[place] = 1.0
        at = RegularGridInterpolator([np.arange(n) * s for n, s in zip(values.shape, SPACING, strict=True)], values)
        x = rng.random((2000, 3)) * 0.99 * SPACING * (np.array(values.shape) - 1)
        gradient = np.stack([(at(x + 1e-6 * e) - at(x)) / 1e-6 for e in np.eye(3)], axis=1)
        steepest = np.linalg.norm(gradient, axis=1).max()
        assert steepest <= steepest_slope(values.astype(np.float32), SPACING) * (1 + 1e-5)


def test_a_sheared_volume_is_as_steep_as_said(device):
    """Planes of voxels at 25 degrees: across them phi changes by the distance along the axis, 1/sin(25 degrees) times
    the distance of the planes."""
    lean = np.radians(25.0)
    directions = np.array([[np.cos(lean), 1.0, 0.0], [np.sin(lean), 0.0, 0.0], [0.0, 0.0, 1.0]])
    volume = np.zeros((12, 60, 60), int)
    volume[:6] = 1
    domain = Domain.from_labels(volume, affine=affine_of(directions, (0.01,) * 3), device=device)
    middle = affine_of(directions, (0.01,) * 3) @ [5.0, 30.0, 30.0, 1.0]
    ends = domain.phi(middle[:3] + np.array([[0.0, 0.0, 0.0], [0.0, 0.004, 0.0]]))
    assert (ends[1] - ends[0]) / 0.004 == pytest.approx(1.0 / np.sin(lean), rel=1e-3)
    assert domain.lipschitz >= 1.0 / np.sin(lean)


def test_a_turned_volume_is_the_same_body_turned(device, rng):
    volume = blobs(rng)
    straight = Domain.from_labels(volume, SPACING, origin=(0.1, -0.2, 0.3), device=device)
    rotation = turned(rng)
    affine = affine_of(np.eye(3), origin=(0.1, -0.2, 0.3))
    affine[:3] = rotation @ affine[:3]
    other = Domain.from_labels(volume, affine=affine, device=device)
    points = straight.bounds[0] + rng.uniform(-0.5, 1.5, (2000, 3)) * np.ptp(straight.bounds, axis=0)
    assert np.allclose(other.phi(points @ rotation.T), straight.phi(points), atol=ROUNDING)
    agree = other.labels_at(points @ rotation.T) == straight.labels_at(points)
    assert agree.mean() > 0.999  # except points halfway between two voxels
    # Axes in another order and one reversed, as scanners write them.
    mixed = np.ascontiguousarray(np.moveaxis(volume, (1, 2, 0), (0, 1, 2))[::-1])
    flipped = affine_of(np.eye(3), origin=(0.1, -0.2, 0.3)) @ np.array(
        [[0, 0, 1, 0], [-1, 0, 0, volume.shape[1] - 1], [0, 1, 0, 0], [0, 0, 0, 1]]
    )
    same = Domain.from_labels(mixed, affine=flipped, device=device)
    assert np.allclose(same.phi(points), straight.phi(points), atol=ROUNDING)


def test_labels_are_those_of_the_voxels(device, rng):
    volume = blobs(rng)
    domain = Domain.from_labels(volume, SPACING, labels={"wall": 7, "rest": [1]}, device=device)
    assert domain.label_names == ("wall", "rest")
    index = np.argwhere(volume >= 0)
    expected = np.select([volume == 7, volume == 1], [1, 2], 0)[tuple(index.T)]
    assert np.array_equal(domain.labels_at(index * SPACING), expected)
    # Outside, the nearest of them: of all voxels inside, in brute force.
    inside = np.argwhere(volume > 0)
    outside = index[expected == 0]
    distance = np.linalg.norm((outside[:, None] - inside[None]) * SPACING, axis=2)
    labels = domain.labels_at(outside * SPACING, nearest=True)
    for row, label in zip(distance, labels, strict=True):
        nearest = inside[np.isclose(row, row.min())]
        assert label in np.where(volume[tuple(nearest.T)] == 7, 1, 2)
    # Each label alone gives the same result as a volume with only this label.
    alone = Domain.from_labels(volume == 7, SPACING, device=device)
    points = domain.bounds[0] + rng.random((2000, 3)) * np.ptp(domain.bounds, axis=0)
    assert np.allclose(domain.part("wall").phi(points), alone.phi(points), atol=ROUNDING)
    assert Domain.from_labels(volume, SPACING).label_names == ("1", "7")
    one = Domain.from_labels(volume, SPACING, labels={"all": (1, 7)})
    assert np.array_equal(one.labels_at(index * SPACING), expected > 0)
    assert Domain.from_labels(volume.astype(np.float32), SPACING).label_names == ("1", "7")


def test_smoothing_takes_the_steps_off(device):
    volume, origin = ball(0.2, (0.01,) * 3)
    rough = Domain.from_labels(volume, (0.01,) * 3, origin=origin, device=device)
    smooth = Domain.from_labels(volume, (0.01,) * 3, origin=origin, smoothing=0.01, device=device)
    rng = np.random.default_rng(1)
    n = rng.standard_normal((2000, 3))
    points = 0.2 * n / np.linalg.norm(n, axis=1, keepdims=True)
    assert smooth.phi(points).std() < 0.5 * rough.phi(points).std()
    assert 1.0 <= smooth.lipschitz < 1.1 < rough.lipschitz <= np.sqrt(3.0) * (1 + 1e-5)
    assert any("smoothed by 10 mm, which changes the volume by" in line for line in smooth.report())
    # The expected result, with enough space around that its end does not matter.
    wide, _ = signed_distance(np.pad(volume, 20) > 0, np.full(3, 0.01))
    centres = np.argwhere(volume)
    assert np.allclose(
        smooth.phi(origin + 0.01 * centres), gaussian_filter(wide, 1.0)[tuple(centres.T + 20)], atol=1e-6
    )
    with pytest.raises(InputError, match=r"smoothing is 50 mm and the body 400 mm long"):
        Domain.from_labels(volume, (0.01,) * 3, smoothing=0.05)
    with pytest.raises(InputError, match="leaves nothing of the body"):
        Domain.from_labels(np.ones((40, 1, 1), int), (0.01,) * 3, smoothing=0.03)


def test_the_likeliest_label_wins(rng):
    shares = rng.dirichlet([1.0, 1.0, 1.0], (6, 5, 4))
    maps = {"grey": shares[..., 1], "white": shares[..., 2]}
    labels = labels_from_probabilities(maps)
    assert labels.dtype == np.int32
    assert np.array_equal(labels, np.argmax(shares, axis=-1))
    bytes_ = {name: np.round(255 * values).astype(np.uint8) for name, values in maps.items()}
    clear = np.sort(shares, axis=-1)[..., 2] - np.sort(shares, axis=-1)[..., 1] > 0.02
    assert np.array_equal(labels_from_probabilities(bytes_, certain=255)[clear], labels[clear])
    domain = Domain.from_probabilities(maps, (0.01,) * 3)
    assert domain.label_names == ("grey", "white")
    index = np.argwhere(labels >= 0)
    assert np.array_equal(domain.labels_at(0.01 * index), labels[tuple(index.T)])
    half = np.full((2, 2, 2), 0.5)
    assert (labels_from_probabilities({"a": half}) == 0).all()
    assert (labels_from_probabilities({"a": half, "b": half}) == 1).all()
