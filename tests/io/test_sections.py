"""Cuts through bodies: areas, and their motion with the mesh."""

import numpy as np
import pytest
from matplotlib.figure import Figure

import warp_corot as wc
from warp_corot.io.pictures.sections import Section

RADIUS, CORE = 0.05, 0.03
ACROSS, UP = np.array([[0.8, 0.0, -0.6], [0.6, 0.0, 0.8]])
REACH = [[-0.06, 0.06], [-0.06, 0.06]]


@pytest.fixture(scope="module")
def ball():
    domain = wc.Domain.sphere(CORE).named("core") | wc.Domain.sphere(RADIUS).named("shell")
    return wc.TetForest.from_domain(domain, 0.04, max_level=6), domain


def areas(section, right, above):
    """Area of each label by the shoelace formula, [labels]."""
    corner = np.stack([right, above], axis=-1)
    a, b = corner[1:, 1:] - corner[:-1, :-1], corner[1:, :-1] - corner[:-1, 1:]
    squares = 0.5 * np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
    return np.array([squares[section.numbers == k + 1].sum() for k in range(len(section.names))])


@pytest.mark.parametrize("height", [0.0, 0.02])
def test_labels_take_their_discs(ball, height):
    """Labels have the domain's resolution with any tetrahedra: squares of 0.5 mm, tetrahedra of 10."""
    section = Section(*ball, [0.0, height, 0.0], ACROSS, UP, REACH, 5e-4)
    core, whole = np.pi * (CORE**2 - height**2), np.pi * (RADIUS**2 - height**2)
    assert areas(section, *section.moved()) == pytest.approx([core, whole - core], rel=5e-3)


def test_an_affine_deformation_carries_it_along(ball):
    mesh, domain = ball
    section = Section(mesh, domain, [0.0, 0.01, 0.0], ACROSS, UP, REACH, 2e-3)
    gradient = np.array([[0.1, 0.2, -0.1], [0.0, 0.3, 0.1], [-0.2, 0.1, -0.15]])
    right, above = section.moved(mesh.points @ gradient.T)
    expected = (section.points @ gradient.T + section.points - [0.0, 0.01, 0.0]) @ np.array([ACROSS, UP]).T
    np.testing.assert_allclose(np.stack([right.ravel(), above.ravel()], axis=1), expected, atol=1e-12)
    before, after = areas(section, *section.moved()), areas(section, right, above)
    in_plane = np.eye(2) + np.array([ACROSS, UP]) @ gradient @ np.array([ACROSS, UP]).T
    np.testing.assert_allclose(after / before, np.linalg.det(in_plane), rtol=1e-9)


def test_it_is_drawn_in_the_labels_colours(ball, tmp_path):
    """The fraction of each colour in a picture of the square that contains the disc."""
    figure = Figure(figsize=(2, 2), dpi=200)
    section = Section(*ball, [0.0, 0.0, 0.0], ACROSS, UP, REACH, 5e-4)
    section.draw(figure.add_axes((0, 0, 1, 1)), None, {"core": (1, 0, 0), "shell": (0, 0, 1)})
    figure.savefig(tmp_path / "cut.png")
    from PIL import Image

    pixels = np.asarray(Image.open(tmp_path / "cut.png").convert("RGB")).reshape(-1, 3).astype(int)
    core, whole = np.pi * CORE**2 / 0.0144, np.pi * RADIUS**2 / 0.0144
    for colour, share in (((255, 0, 0), core), ((0, 0, 255), whole - core), ((255, 255, 255), 1 - whole)):
        assert (np.abs(pixels - colour).max(axis=1) < 8).mean() == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"across": [1.0, 0.0, 0.0]}, "right angles"),
        ({"up": [0.6, 0.0, 0.9]}, "unit vectors"),
        ({"reach": [[0.0, 0.0], [-1.0, 1.0]]}, "squares"),
        ({"step": 0.0}, "squares"),
        ({"step": 1e-6}, "1 to 2000 each way"),
        ({"step": np.nan}, "squares"),
        ({"reach": [0.0, 1.0]}, r"reach is .* \[2, 2\]"),
        ({"reach": [[0.0, np.inf], [0.0, 1.0]]}, "reach is"),
        ({"centre": [0.0, 0.0]}, r"centre is \[0.0, 0.0\]; it must be finite numbers \[3\]"),
        ({"across": [1.0, [0.0], 0.0]}, "across is"),
    ],
)
def test_bad_planes(ball, given, named):
    plane = {"centre": [0.0, 0.0, 0.0], "across": ACROSS, "up": UP, "reach": REACH, "step": 1e-3} | given
    with pytest.raises(wc.InputError, match=named):
        Section(*ball, **plane)


def test_every_label_needs_a_colour(ball):
    section = Section(*ball, [0.0, 0.0, 0.0], ACROSS, UP, REACH, 2e-3)
    with pytest.raises(wc.InputError, match="shell"):
        section.draw(Figure().subplots(), None, {"core": "red"})
