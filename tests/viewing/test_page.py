"""The page in a real browser: it loads, a drag moves tissue, the plot shows the force, what is saved arrives.

Screenshots are in pytest's temporary folder, ``page0`` and so on.
"""

import io
import re
import time
import tomllib

import numpy as np
import pytest
from browser import browser
from hands import block
from PIL import Image

import warp_corot as wc
from warp_corot.viewing.view import View

#: Small, since there is no graphics card to draw it; the panel on the right takes 325 pixels.
TAB = {"width": 900, "height": 560}
SCENE = {"x": 0, "y": 150, "width": 560, "height": 410}
PATIENCE = 60.0


@pytest.fixture(scope="module")
def chromium():
    with browser() as found:
        yield found


@pytest.fixture
def page(chromium, request):
    options = dict(getattr(request, "param", {}))
    sim = options.pop("sim", block)(level=6)
    with View(sim, port=0, run_file=lambda sim: b'input = "box"\n', **options) as opened:
        opened.session.change(fps=10.0)
        opened.start()
        yield opened


@pytest.fixture
def tab(chromium, page):
    yield from new_tab(chromium, page)


def new_tab(chromium, page):
    context = chromium.new_context(viewport=TAB, accept_downloads=True)
    tab = context.new_page()
    tab.errors = []
    tab.on("pageerror", lambda error: tab.errors.append(str(error)))
    tab.goto(page.address)
    tab.get_by_text("force on the tissue").wait_for(timeout=1e3 * PATIENCE)
    yield tab
    context.close()


def until(true, what):
    """Wait until a condition holds."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if true():
            return
        time.sleep(0.1)
    raise AssertionError(f"{what}: not within {PATIENCE:g} s")


def press_mouse(tab, seen, by=(80, -60)):
    """Press the mouse on the body, where the scene is not empty, and move it."""
    rows, columns = np.nonzero(seen)
    start = np.array([np.median(columns), np.median(rows[np.abs(columns - np.median(columns)) < 3])])
    tab.mouse.move(*start)
    tab.mouse.down()
    for share in (0.2, 0.6, 1.0):
        tab.mouse.move(*(start + share * np.array(by)))
        time.sleep(0.1)
    return start


def drawn(tab, path=None):
    """Where the scene in a tab is not empty, bool [rows, columns]; what covers it is left out.

    Chromium takes four seconds of a core for a picture; the file is for the reader of a failure.
    """
    taken = tab.screenshot(clip=SCENE, path=path, timeout=1e3 * PATIENCE)
    picture = np.asarray(Image.open(io.BytesIO(taken)).convert("RGB"))
    return np.pad(picture.min(axis=2) < 250, ((SCENE["y"], 0), (0, 0)))


def when_drawn(tab, path=None):
    """The same, as soon as something is drawn."""
    seen = []
    until(lambda: seen.append(drawn(tab, path)) or seen[-1].any(), "the scene is drawn")
    return seen[-1]


def held(page):
    with page.held() as sim:
        return np.abs(sim.body.displacements.numpy()).max(), [hand.force for hand in page.session.hands.values()]


def newtons(tab):
    """The force that the page shows [N]."""
    text = tab.get_by_text("force on the tissue").inner_text()
    number, unit = re.search(r"([\d.e-]+) (m?N)", text).groups()
    return float(number) * (1e-3 if unit == "mN" else 1.0)


def plotted(tab):
    """Pixels of the plot's curve, by their rows."""
    found = tab.evaluate(
        """() => { const canvas = document.querySelector('.uplot canvas');
        return [canvas.width, ...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data] }"""
    )
    pixels = np.array(found[1:], np.uint8).reshape(-1, found[0], 4).astype(int)
    curve = (pixels[..., 2] > pixels[..., 0] + 60) & (pixels[..., 3] > 100)
    return np.nonzero(curve.any(axis=1))[0]


def test_a_drag_moves_tissue_and_the_plot_shows_its_force(tab, page, tmp_path):
    before = when_drawn(tab, tmp_path / "loaded.png")
    assert newtons(tab) == 0.0
    flat = plotted(tab)
    assert np.ptp(flat) < 5
    press_mouse(tab, before)
    until(lambda: held(page)[1] and held(page)[0] > 0.002, "the tissue moves")
    (force,) = held(page)[1]
    assert np.linalg.norm(force) > 0.01
    until(lambda: newtons(tab) > 0.01, "the force is told")
    until(lambda: np.ptp(plotted(tab)) > 20, "the plot shows the force")
    assert (drawn(tab, tmp_path / "dragged.png") != before).sum() > 200
    tab.mouse.up()
    until(lambda: not held(page)[1] and held(page)[0] < 1e-4, "the tissue goes back")
    until(lambda: newtons(tab) == 0.0, "no force is told")
    assert tab.errors == []


def below_a_ball(level):
    """A block and a ball above it."""
    return block(level=level, obstacles=wc.Tool(wc.Sphere(radius=0.05, position=(0.05, 0.05, 0.252))))


@pytest.mark.slow
@pytest.mark.parametrize("page", [{"sim": below_a_ball}], indirect=True)
def test_a_tool_follows_the_mouse_and_presses(tab, page, tmp_path):
    # The ball is nearest to the viewer, on the left; away from there it goes into the block.
    rows, columns = np.nonzero(when_drawn(tab))
    start = np.array([columns.min() + 80.0, np.median(rows[columns < columns.min() + 80])])
    tab.mouse.move(*start)
    tab.mouse.down()
    for share in (0.3, 0.7, 1.0):
        tab.mouse.move(*(start + share * np.array([40.0, -15.0])))
        time.sleep(0.1)
    (tool,) = page.sim.obstacles
    until(lambda: held(page)[1] and held(page)[1][0][2] < -0.1, "the ball presses")
    assert held(page)[0] > 0.002
    until(lambda: newtons(tab) > 0.1, "the force is told")
    tab.screenshot(path=tmp_path / "pressed.png")
    tab.mouse.up()
    with page.held():
        assert tool.present_pose[0][2] < 0.25
    assert tab.errors == []


@pytest.mark.slow
def test_reloads_and_lost_connections_do_no_harm(tab, page, tmp_path):
    press_mouse(tab, when_drawn(tab))
    until(lambda: held(page)[1], "the tissue is held")
    tab.reload()
    until(lambda: not held(page)[1], "who is gone holds nothing")
    tab.get_by_text("force on the tissue").wait_for(timeout=1e3 * PATIENCE)
    page._server._websock_server.disconnect_all_clients()
    until(lambda: len(page._server.get_clients()) == 1, "the browser comes back")
    tab.get_by_text("force on the tissue").wait_for(timeout=1e3 * PATIENCE)
    press_mouse(tab, when_drawn(tab))
    until(lambda: held(page)[1], "the tissue is held again")
    tab.screenshot(path=tmp_path / "again.png")
    tab.mouse.up()
    assert tab.errors == []


@pytest.mark.slow
def test_two_visitors_see_the_same_and_both_have_hands(chromium, tab, page):
    for second in new_tab(chromium, page):
        press_mouse(tab, when_drawn(tab))
        press_mouse(second, when_drawn(second), by=(-60, -40))
        until(lambda: len(held(page)[1]) == 2, "both hold the tissue")
        second.context.close()
        until(lambda: len(held(page)[1]) == 1, "one holds it still")
        tab.mouse.up()
        break


@pytest.mark.slow
def test_controls(tab, page, tmp_path):
    tab.get_by_role("button", name="pause").click()
    until(lambda: not page.session.controls.running, "paused")
    steps = page.sim.total_steps
    tab.get_by_role("button", name="one step").click()
    until(lambda: page.sim.total_steps == steps + 1, "one step is made")
    tab.get_by_role("button", name="go on").click()
    until(lambda: page.session.controls.running, "time goes on")
    tab.get_by_role("button", name="reset").click()
    until(lambda: page.sim.total_time > page.sim.time, "it begins anew")
    choose(tab, "colours", "displacement")
    until(lambda: page.session.controls.colors == "displacement", "colours are others")
    choose(tab, "cut", "x")
    until(lambda: page.session.controls.plane is not None, "the body is cut")
    tab.screenshot(path=tmp_path / "cut.png")
    tab.get_by_text("tissue", exact=True).click()
    choose(tab, "law", "neo-hookean")
    former = page.sim
    tab.get_by_role("button", name="switch").click()
    until(lambda: isinstance(page.sim.models[0], wc.NeoHookean), "the law is another")
    assert page.sim is not former
    tab.screenshot(path=tmp_path / "switched.png")
    assert tab.errors == []


def choose(tab, label, value):
    tab.get_by_label(label, exact=True).first.click()
    tab.get_by_role("option", name=value, exact=True).click()


@pytest.mark.slow
def test_what_is_saved_arrives(tab, page, tmp_path):
    tab.get_by_text("save", exact=True).click()
    saved = {}
    for name in ("picture", "checkpoint", "run file", "USD animation", "film"):
        with tab.expect_download(timeout=2e3 * PATIENCE) as download:
            tab.get_by_role("button", name=name, exact=True).click()
            if name in ("USD animation", "film"):
                until(lambda: re.search(r"frame ([2-9]|\d\d)", page.session.note), "frames are made")
                tab.get_by_role("button", name="end early").click()
        saved[name] = tmp_path / download.value.suggested_filename
        download.value.save_as(saved[name])
    picture = np.asarray(Image.open(saved["picture"]))
    assert picture.shape == (720, 1280, 3)
    assert 10_000 < (picture.min(axis=2) < 250).sum() < 600_000
    assert wc.Simulation.load(saved["checkpoint"]).body.element_count == page.sim.body.element_count
    assert tomllib.loads(saved["run file"].read_text()) == {"input": "box"}
    from pxr import Usd

    stage = Usd.Stage.Open(str(saved["USD animation"]))
    assert stage.GetEndTimeCode() >= 2
    assert saved["film"].suffix in (".mp4", ".gif")
    assert saved["film"].stat().st_size > 1000


@pytest.mark.parametrize("page", [{"token": "open sesame"}], indirect=True)
def test_without_the_token_there_is_no_page(chromium, page, tmp_path):
    context = chromium.new_context(viewport=TAB)
    tab = context.new_page()
    closed = page.address.partition("?")[0]
    for address in (closed, f"{closed}?token=wrong"):
        assert tab.goto(address).status == 403
        assert "The page is closed" in tab.inner_text("body")
    opened = tab.evaluate(
        """address => new Promise(done => { const socket = new WebSocket(address, 'viser-v0');
        socket.onopen = () => done(true); socket.onerror = () => done(false) })""",
        closed.replace("http", "ws"),
    )
    assert opened is False
    tab.goto(page.address)
    tab.get_by_text("force on the tissue").wait_for(timeout=1e3 * PATIENCE)
    assert "token" not in tab.url
    tab.reload()
    tab.get_by_text("force on the tissue").wait_for(timeout=1e3 * PATIENCE)
    context.close()
