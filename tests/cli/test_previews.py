"""``--preview``: frames, views and films; a legend that is never truncated."""

import numpy as np
import pytest
from command_line import SHORT, simulate

pytest.importorskip("matplotlib")
from pictures import CUBE, FACES, picture_of, render_preview, render_strip
from PIL import Image, ImageChops

from warp_corot.io.pictures.preview import Picture, fit_line, write_film

RUN = ["box", "-o", "a.usd", *SHORT]  # frames 0, 1 and 2


@pytest.mark.parametrize("size", [(1200, 900), (500, 240), (300, 240)])
@pytest.mark.parametrize(
    ("largest", "label"),
    [
        (1.0, "von Mises stress [Pa]"),
        (3.2e6, "von Mises stress [Pa]"),
        (1.5e-5, "a quantity of a very long name [m/s^2]"),
    ],
)
def test_the_legend_is_never_cut(tmp_path, largest, label, size):
    """Its drawing ends before the picture does, on all sides."""
    path = tmp_path / "a.png"
    stress = np.linspace(0.0, largest, len(CUBE))
    render_preview(path, CUBE, FACES, scalars=stress, value_range=(0, largest), scalar_label=label, size=size)
    dark = picture_of(path).min(axis=2) < 200
    assert dark.shape == size[::-1]
    assert dark[:, -size[0] // 3 :].any()
    for side in (dark[:, -3:], dark[:2], dark[-2:]):
        assert not side.any()


def test_titles_are_never_cut(tmp_path):
    words = "a liver of somebody, held where z < zmin + 0.01 and x > 0.2 or y < 0.1, which is long"
    render_preview(tmp_path / "a.png", CUBE, FACES, title=words, size=(400, 300))
    render_strip(tmp_path / "b.png", [Picture(CUBE, FACES, title=words)] * 3, title=2 * words, size=(600, 300))
    for name in ("a.png", "b.png"):
        top = picture_of(tmp_path / name)[:70].min(axis=2) < 200
        assert top.any()
        assert not top[:, :3].any()
        assert not top[:, -3:].any()


def test_a_title_that_is_too_long_keeps_its_time(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(
        "warp_corot.io.pictures.preview.fit_line", lambda *given: written.append(fit_line(*given)) or written[-1]
    )
    words = "; ".join(["held where " + " or ".join(f"x < {n}" for n in range(40))] * 2)
    render_preview(tmp_path / "a.png", CUBE, FACES, title=f"{words}; 0.25 s", size=(400, 300))
    ((said, _),) = written
    assert said.startswith("held where x < 0 or")
    assert said.endswith(" …; 0.25 s")


def test_views_and_frames_are_panels(folder):
    assert simulate(*RUN, "--preview", "a.png", "--preview-views", "front,left", "--preview-frames", "0,-1") == 0
    pixels = picture_of(folder / "a.png")
    body = np.ptp(pixels, axis=2) > 40
    rows = np.array_split(body[60:], 2)
    panels = [panel for row in rows for panel in np.array_split(row[:, : 2 * 535], 2, axis=1)]
    widths = [np.ptp(np.nonzero(panel.any(axis=0))[0]) for panel in panels]
    assert len(widths) == 4
    # The box is three times as long as wide, and one of the two views shows its end.
    assert max(widths[0], widths[1]) > 2 * min(widths[0], widths[1])
    assert np.abs(panels[0] ^ panels[2])[:, :-40].any()  # it has moved


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--young", "30kPa", "--drop", "5cm"], "box, 1,152 elements, 30 kPa; 0.05 s"),
        (["--density", 5, "--static"], "box, 1,152 elements, 500 Pa, at rest"),
    ],
)
def test_titles_say_what_is_shown(folder, options, said, monkeypatch):
    titles = []
    monkeypatch.setattr("warp_corot.io.pictures.preview.Strip.draw", lambda *given: titles.append(given[-1]))
    monkeypatch.setattr("warp_corot.io.pictures.preview.save_picture", lambda *_: None)
    assert simulate(*RUN, "--preview", "a.png", *options) == 0
    assert titles == [said]


def test_a_frame_is_the_one_that_was_asked_for(folder):
    for number in ("0", "2", "-1"):
        assert simulate(*RUN, "--preview", f"{number}.png", "--preview-frames", number) == 0
    first, last, also = (Image.open(folder / f"{number}.png").convert("RGB") for number in ("0", "2", "-1"))
    assert ImageChops.difference(first, last).getbbox() is not None
    assert ImageChops.difference(last, also).getbbox() is None


def test_a_gif_has_all_frames_in_time(folder):
    assert simulate(*RUN, "--preview", "a.gif") == 0
    with Image.open(folder / "a.gif") as film:
        assert film.n_frames == 2  # every other one of 40 a second
        assert film.info["duration"] == 50
        sizes = []
        for k in range(film.n_frames):
            film.seek(k)
            sizes.append(film.size)
    assert len(set(sizes)) == 1
    assert {file.name for file in folder.iterdir()} == {"a.usd", "a.gif"}


def test_a_gif_keeps_colors_that_its_last_frame_has_not(tmp_path):
    ramp = np.linspace(0, 255, 256).astype(np.uint8)
    grey, purple = (np.stack([ramp, ramp * share, ramp], axis=1)[None].repeat(8, axis=0) for share in (1, 0))
    write_film(tmp_path / "a.gif", (Image.fromarray(each) for each in (grey, purple, grey)), 10.0)
    with Image.open(tmp_path / "a.gif") as film:
        film.seek(1)
        shown = np.asarray(film.convert("RGB")).astype(int)
    assert np.abs(shown - purple).mean() < 4.0


def test_an_mp4_has_all_frames(folder):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    assert simulate(*RUN, "--preview", "a.mp4") == 0
    with imageio.get_reader(folder / "a.mp4") as film:
        frames = [np.asarray(frame) for frame in film]
        assert film.get_meta_data()["fps"] == pytest.approx(40.0)
    assert len(frames) == 3
    assert {file.name for file in folder.iterdir()} == {"a.usd", "a.mp4"}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--preview", "a.png", "--preview-frames", "7"], "there is no frame 7; the last one is 2"),
        (["--preview", "a.png", "--preview-frames", "1,x"], "'x' must be a whole number"),
        (
            ["--preview", "a.png", "--preview-frames", "0,1,2", "--preview-views", "front,left,right,top,back"],
            "at most 12",
        ),
        (["--preview", "a.gif", "--preview-frames", "1"], "--preview-frames is for a .png"),
        (["--preview", "a.png", "--preview-views", "up"], "'up' must be corner, front"),
        (["--preview", "a.png", "--preview-views", "10:95"], "'10:95' must be"),
        (["--preview-views", "front"], "--preview-views is for --preview, which is not given"),
        (["--preview", "a.jpg"], "a.jpg: extension .jpg; it must be .png, .gif, .mp4"),
    ],
)
def test_what_is_refused(folder, capsys, options, said):
    assert simulate(*RUN, *options) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(errors) == 1
    assert said in errors[0]
    assert list(folder.iterdir()) == []


def test_a_film_without_its_package_is_one_line(folder, capsys, monkeypatch):
    monkeypatch.setattr("warp_corot.io.pictures.preview.find_spec", lambda name: None)
    assert simulate(*RUN, "--preview", "a.mp4") == 2
    assert 'pip install "warp-corot[film]"; a .gif needs no package' in capsys.readouterr().err
