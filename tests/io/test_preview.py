"""Pictures: visible parts are in the right place and colour."""

import sys

import numpy as np
import pytest

from warp_corot.errors import InputError
from warp_corot.io.pictures.colors import stress_colors

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure
from pictures import CUBE, FACES, SIZE, picture_of, render_preview, render_strip

from warp_corot.io.pictures import preview
from warp_corot.io.pictures.drawing import Camera, draw_body
from warp_corot.io.pictures.preview import Picture


def body_pixels(path) -> np.ndarray:
    """Pixels that are neither white nor a grey of shadow or silhouette."""
    pixels = picture_of(path)
    return np.ptp(pixels, axis=2) > 25


@pytest.mark.parametrize("up_axis", ["X", "Y", "Z"])
def test_the_camera_sees_up_as_up_and_near_as_large(up_axis):
    up = np.eye(3)["XYZ".index(up_axis)]
    camera = Camera.fit(CUBE, up_axis)
    assert np.allclose(camera.axes @ camera.axes.T, np.eye(3))
    assert np.isclose(np.linalg.det(camera.axes), 1.0)
    flat, depth = camera.project(np.stack([-up, 0.0 * up, up]) * 0.5)
    assert np.allclose(flat[:, 0], 0.0)
    assert flat[0, 1] < flat[1, 1] < flat[2, 1]
    # Two rods of one length: the nearer one looks slightly longer.
    towards = camera.axes[2]
    rod = np.stack([-up, up]) * 0.1
    near, far = (np.ptp(camera.project(rod + s * towards)[0], axis=0)[1] for s in (0.5, -0.5))
    assert 1.0 < near / far < 1.5
    assert depth[2] > depth[0]  # seen a little from above


def test_each_picture_shows_the_body_in_its_middle(tmp_path):
    path = tmp_path / "cube.png"
    render_preview(path, CUBE, FACES, size=SIZE)
    body = body_pixels(path)
    assert body.shape == SIZE[::-1]
    rows, columns = np.nonzero(body)
    assert 0.1 < body.mean() < 0.6
    assert body[120, 150]
    assert rows.min() > 0
    assert columns.min() > 0
    corner = picture_of(path)[:5, :5]
    assert (corner == 255).all()


def test_only_faces_that_look_outward_are_seen(tmp_path):
    """An inside-out cube shows its far walls from within: less light falls on them than on the outer top."""
    render_preview(tmp_path / "out.png", CUBE, FACES, size=SIZE, ground=False)
    render_preview(tmp_path / "in.png", CUBE, FACES[:, ::-1], size=SIZE, ground=False)
    outside, inside = picture_of(tmp_path / "out.png"), picture_of(tmp_path / "in.png")
    assert np.abs(outside - inside).max() > 40
    covered_outside, covered_inside = (body_pixels(tmp_path / name).sum() for name in ("out.png", "in.png"))
    assert abs(covered_outside - covered_inside) < 0.05 * covered_outside


def test_nearer_bodies_hide_farther_ones(tmp_path):
    """A red cube before a blue one hides it, whichever is listed first."""
    camera_points = np.concatenate([CUBE, CUBE + np.array([0, 0, 3])])
    for order in ([0, 1], [1, 0]):
        points = np.concatenate([camera_points[8 * k : 8 * k + 8] for k in order])
        scalars = np.repeat([1.0 - k for k in order], 8)  # the far cube has the largest value, a dark colour
        faces = np.concatenate([FACES, FACES + 8])
        path = tmp_path / f"{order[0]}.png"
        render_preview(
            path,
            points,
            faces,
            scalars=scalars,
            value_range=(0, 1),
            view=(0.0, 0.0),
            size=SIZE,
            ground=False,
        )
        middle = picture_of(path)[SIZE[1] // 2, (SIZE[0] - 130) // 2] / 255.0
        light, dark = stress_colors()[0], stress_colors()[-1]
        assert np.abs(middle - light).max() < np.abs(middle - dark).max()


@pytest.mark.parametrize("per", ["node", "face"])
def test_scalars_become_the_colors_of_the_map(tmp_path, per):
    """A face seen straight on has its value's hue; the shading only dims it."""
    for value in (0.0, 0.5, 1.0):
        path = tmp_path / f"{value}.png"
        scalars = np.full(len(CUBE) if per == "node" else len(FACES), value)
        render_preview(path, CUBE, FACES, scalars=scalars, value_range=(0, 1), view=(0.0, 0.0), size=SIZE, ground=False)
        seen = picture_of(path)[SIZE[1] // 2, (SIZE[0] - 130) // 2] / 255.0
        wanted = stress_colors()[round(255 * value)]
        assert np.abs(seen / seen.max() - wanted / wanted.max()).max() < 0.2


def test_the_rest_shape_stands_behind(tmp_path):
    moved = CUBE * 0.4
    render_preview(tmp_path / "with.png", moved, FACES, rest=CUBE, size=SIZE, ground=False)
    pixels = picture_of(tmp_path / "with.png")
    grey = (np.ptp(pixels, axis=2) < 20) & (pixels.min(axis=2) < 240)
    body = body_pixels(tmp_path / "with.png")
    assert grey.sum() > 2 * body.sum() > 0


def test_one_scale_and_one_color_range_in_a_strip(tmp_path):
    path = tmp_path / "strip.png"
    stress = np.linspace(0.0, 1e3, len(CUBE))
    pictures = [
        Picture(CUBE, FACES, title="small"),
        Picture(CUBE, FACES, stress, CUBE, "with stress", {"edges": True, "ground": False}),
        Picture(2.0 * CUBE, FACES, title="large"),
    ]
    render_strip(path, pictures, title="cubes", size=(900, 300))
    body = body_pixels(path)[:, : 900 - 130]
    panels = np.array_split(body, 3, axis=1)
    widths = [np.ptp(np.nonzero(panel.any(axis=0))[0]) for panel in panels]
    assert 1.8 < widths[2] / widths[0] < 2.8  # twice as large, and a little more for being nearer
    assert abs(widths[1] - widths[0]) <= 3
    render_strip(path, pictures)
    assert picture_of(path).shape[1] == 1800


def test_drawing_into_a_users_axes():
    figure = Figure()
    left, right = figure.subplots(1, 2)
    camera = draw_body(left, CUBE, FACES, scalars=np.arange(8.0), edges=True)
    assert draw_body(right, 0.5 * CUBE, FACES, camera=camera, ground=-0.5) is camera
    assert left.images
    assert right.images
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()


def test_flat_faces_and_stray_nodes_do_no_harm(tmp_path):
    flat = CUBE * [1.0, 0.0, 1.0]
    render_preview(tmp_path / "flat.png", flat, FACES, scalars=np.zeros(8), size=SIZE)
    stray = np.concatenate([CUBE, [[np.nan, 0.0, 0.0]]])
    render_preview(tmp_path / "stray.png", stray, FACES, scalars=np.full(9, np.nan), size=SIZE)
    render_preview(tmp_path / "point.png", np.zeros((8, 3)), FACES, size=SIZE)


def test_bad_input_is_refused_and_keeps_the_picture(tmp_path, monkeypatch):
    path = tmp_path / "good.png"
    render_preview(path, CUBE, FACES, size=SIZE)
    good = path.read_bytes()
    nan = CUBE.copy()
    nan[2, 1] = np.nan
    for arguments, options, match in [
        ((path, nan, FACES), {}, "not finite"),
        ((path, CUBE[:, :2], FACES), {}, r"shape \[8, 2\]; it must be \[N, 3\]"),
        ((path, CUBE, FACES[:0]), {}, "at least one face"),
        ((path, CUBE[:5], FACES), {}, "nodes 0 to 4"),
        ((path, CUBE, FACES), {"scalars": np.zeros(3)}, r"scalars has shape \[3\]"),
        ((path, CUBE, FACES), {"up_axis": "up"}, "must be X, Y or Z"),
    ]:
        with pytest.raises(InputError, match=match):
            render_preview(*arguments, size=SIZE, **options)

    monkeypatch.setattr(preview, "find_spec", lambda name: None)
    preview.font_of.cache_clear()
    with pytest.raises(InputError, match=r'pip install "warp-corot\[plot\]"'):
        render_preview(path, CUBE, FACES, size=SIZE)
    assert path.read_bytes() == good


def test_held_nodes_are_marked_where_they_can_be_seen(tmp_path):
    """The near corner is marked, and not the one behind the body."""
    pictures = {}
    near, far = (int(np.argmax(CUBE @ [1.0, 1.0, 2.0] * sign)) for sign in (1.0, -1.0))
    for name, node in (("none", None), ("near", near), ("far", far)):
        held = np.arange(len(CUBE)) == (-1 if node is None else node)
        render_preview(tmp_path / "a.png", CUBE, FACES, held=held, size=SIZE)
        pictures[name] = picture_of(tmp_path / "a.png").astype(int)
    assert np.abs(pictures["near"] - pictures["none"]).max() > 60
    np.testing.assert_array_equal(pictures["far"], pictures["none"])


def test_dots_are_hidden_by_what_is_before_them(tmp_path):
    """The near corner of a second cube behind the first is hidden, however coarsely the first one is drawn."""
    towards = np.array([1.0, 1.0, 2.0])
    both = np.concatenate([CUBE, CUBE - 1.5 * (CUBE.max() - CUBE.min()) * towards / 2.0])
    faces = np.concatenate([FACES, FACES + len(CUBE)])
    pictures = {}
    for name, node in (("none", None), ("hidden", len(CUBE) + int(np.argmax(CUBE @ towards)))):
        held = np.arange(len(both)) == (-1 if node is None else node)
        # From along that diagonal, so that the corner is behind the middle of the first.
        azimuth, elevation = np.degrees([np.arctan2(1.0, 2.0), np.arctan2(1.0, np.sqrt(5.0))])
        view = (azimuth, elevation)
        render_preview(tmp_path / "a.png", both, faces, held=held, size=SIZE, view=view)
        pictures[name] = picture_of(tmp_path / "a.png").astype(int)
    np.testing.assert_array_equal(pictures["hidden"], pictures["none"])
