"""The page in a real browser: it loads, a drag moves tissue, the plot shows the force, what is saved arrives.

Screenshots are in pytest's temporary folder, ``page0`` and so on.
"""

import asyncio
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

#: Small, since there is no graphics card to draw it; the panel on the right takes 264 pixels.
TAB = {"width": 900, "height": 620}
#: The scene without what lies over it.
SCENE = {"x": 20, "y": 70, "width": 590, "height": 400}
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
    tab.get_by_text("× real time").wait_for(timeout=1e3 * PATIENCE)
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
    """Where a body is in the scene in a tab, by its colours, bool [rows, columns]; the ground has none.

    Chromium takes four seconds of a core for a picture; the file is for the reader of a failure.
    """
    taken = tab.screenshot(clip=SCENE, path=path, timeout=1e3 * PATIENCE)
    return np.pad(colored(Image.open(io.BytesIO(taken))), ((SCENE["y"], 0), (SCENE["x"], 0)))


def colored(picture):
    return np.ptp(np.asarray(picture.convert("RGB")).astype(int), axis=2) > 40


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
    number, unit = re.search(r"([\d.e-]+) (.?N)", tab.locator("#force").inner_text()).groups()
    return float(number) * {"µN": 1e-6, "mN": 1e-3, "N": 1.0}[unit]


def plotted(tab):
    """Pixels of the plot's curve, by their rows."""
    found = tab.evaluate(
        """() => { const canvas = document.querySelector('#curve');
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
    assert not arrows(tab)
    press_mouse(tab, before)
    until(lambda: held(page)[1] and held(page)[0] > 0.002, "the tissue moves")
    (force,) = held(page)[1]
    assert np.linalg.norm(force) > 0.01
    until(lambda: newtons(tab) > 0.01, "the force is told")
    until(lambda: np.ptp(plotted(tab)) > 20, "the plot shows the force")
    assert (drawn(tab, tmp_path / "dragged.png") != before).sum() > 200
    assert arrows(tab) == 1
    tab.mouse.up()
    until(lambda: not held(page)[1] and held(page)[0] < 1e-4, "the tissue goes back")
    until(lambda: newtons(tab) == 0.0, "no force is told")
    assert not arrows(tab)
    assert tab.errors == []


def arrows(tab):
    return tab.locator("#arrows line").count()


@pytest.mark.parametrize("size", [(1280, 800), (900, 620)])
def test_all_of_the_page_is_in_the_window_and_is_explained(tab, page, size, tmp_path):
    tab.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
    seen = []

    def fits():
        """The body fills the room that it has, and ends before the edges."""
        picture = colored(Image.open(io.BytesIO(tab.screenshot(path=tmp_path / "page.png", timeout=1e3 * PATIENCE))))
        rows, columns = np.nonzero(picture[60 : size[1] - 140, 20 : size[0] - 290])
        seen[:] = [np.ptp(rows), np.ptp(columns)] if len(rows) else [0, 0]
        return max(seen[0] / (size[1] - 204), seen[1] / (size[0] - 312)) > 0.8

    until(fits, "the body fills the picture")
    left_over = tab.evaluate(
        "() => { const p = document.querySelector('#panel'); return p.scrollHeight - p.clientHeight }"
    )
    assert left_over <= 0
    bare = tab.evaluate(
        """() => [...document.querySelectorAll('#panel :is(input, select, button, summary)')]
        .filter(each => !each.closest('[title]')).map(each => each.outerHTML)"""
    )
    assert bare == []
    for text in ("von Mises stress [", "time [s]", "× real time", "frames/s"):
        assert text.lower() in tab.inner_text("#stage").lower() or text == "time [s]", text


def ball_and_body(tab, path):
    """Where a ball and a body are, as soon as both are seen; nothing but the ball is blue-grey."""
    found = []

    def seen():
        taken = tab.screenshot(clip=SCENE, path=path, timeout=1e3 * PATIENCE)
        picture = np.asarray(Image.open(io.BytesIO(taken)).convert("RGB")).astype(int)
        colors = np.ptp(picture, axis=2)
        ball = (picture[..., 2] - picture[..., 0] > 22) & (colors < 40)
        found[:] = [np.median(np.argwhere(each), axis=0)[::-1] for each in (ball, colors > 40) if each.sum() > 2000]
        return len(found) == 2

    until(seen, "the ball is beside the body")
    return [each + np.array([SCENE["x"], SCENE["y"]]) for each in found]


def towards(ball, body, share):
    """A place between them, at the height of the ball."""
    return ball[0] + share * (body[0] - ball[0]), ball[1]


@pytest.mark.slow
def test_a_ball_of_the_page_presses_and_a_preset_makes_it_liver(tab, page, tmp_path):
    when_drawn(tab)
    tab.get_by_text("Ball", exact=True).click()
    until(lambda: page.session.tool == "ball", "there is a ball")
    tool = page.sim.obstacles[0]
    ball, body = ball_and_body(tab, tmp_path / "ball.png")
    tab.mouse.move(*ball)
    tab.mouse.down()
    for share in (0.3, 0.6, 0.8):
        tab.mouse.move(*towards(ball, body, share))
        time.sleep(0.2)
    until(lambda: held(page)[1] and np.linalg.norm(held(page)[1][0]) > 0.01, "the ball presses")
    tab.mouse.up()
    assert page.sim.obstacles[0] is tool
    tab.locator("#tissue").select_option("liver")
    until(lambda: page.sim.body.material.young == pytest.approx(5.5e3), "it is liver")
    tab.get_by_text("Pull", exact=True).click()
    until(lambda: not page.sim.obstacles, "the ball is away")
    assert tab.errors == []


def below_a_ball(level):
    """A block and a ball above it."""
    return block(level=level, obstacles=wc.Tool(wc.Sphere(radius=0.05, position=(0.05, 0.05, 0.252))))


@pytest.mark.slow
@pytest.mark.parametrize("page", [{"sim": below_a_ball}], indirect=True)
def test_a_tool_follows_the_mouse_and_presses(tab, page, tmp_path):
    ball, body = ball_and_body(tab, tmp_path / "beside.png")
    tab.mouse.move(*ball)
    tab.mouse.down()
    for share in (0.3, 0.7, 1.0):
        tab.mouse.move(*towards(ball, body, 0.5 * share))
        time.sleep(0.1)
    (tool,) = page.sim.obstacles
    until(lambda: held(page)[1] and np.linalg.norm(held(page)[1][0]) > 0.1, "the ball presses")
    until(lambda: held(page)[0] > 0.002, "the tissue moves")
    until(lambda: newtons(tab) > 0.1, "the force is told")
    tab.screenshot(path=tmp_path / "pressed.png")
    tab.mouse.up()
    with page.held():
        assert np.linalg.norm(tool.present_pose[0, :3] - [0.05, 0.05, 0.252]) > 0.002
    assert tab.errors == []


@pytest.mark.slow
def test_reloads_and_lost_connections_do_no_harm(tab, page, tmp_path):
    press_mouse(tab, when_drawn(tab))
    until(lambda: held(page)[1], "the tissue is held")
    tab.reload()
    until(lambda: not held(page)[1], "who is gone holds nothing")
    tab.get_by_text("× real time").wait_for(timeout=1e3 * PATIENCE)
    for visitor in list(page._server.visitors.values()):
        asyncio.run_coroutine_threadsafe(visitor._socket.close(), page._server._loop).result()
    until(lambda: len(page._server.visitors) == 1, "the browser comes back")
    tab.get_by_text("× real time").wait_for(timeout=1e3 * PATIENCE)
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
    tab.get_by_role("button", name="Pause").click()
    until(lambda: not page.session.controls.running, "paused")
    steps = page.sim.total_steps
    tab.get_by_role("button", name="One step").click()
    until(lambda: page.sim.total_steps == steps + 1, "one step is made")
    tab.get_by_role("button", name="Go on").click()
    until(lambda: page.session.controls.running, "time goes on")
    tab.get_by_role("button", name="Start again").click()
    until(lambda: page.sim.total_time > page.sim.time, "it begins anew")
    tab.locator("[name=colors]").select_option("displacement")
    until(lambda: page.session.controls.colors == "displacement", "colours are others")
    tab.locator("#axis").select_option("x")
    until(lambda: page.session.controls.plane is not None, "the body is cut")
    tab.screenshot(path=tmp_path / "cut.png")
    tab.get_by_text("Model", exact=True).click()
    former = page.sim
    tab.locator("[name=law]").select_option("neo-hookean")
    until(lambda: isinstance(page.sim.models[0], wc.NeoHookean), "the law is another")
    assert page.sim is not former
    tab.screenshot(path=tmp_path / "switched.png")
    assert tab.errors == []


@pytest.mark.slow
def test_what_is_saved_arrives(tab, page, tmp_path):
    tab.locator("#seconds").fill("60")
    saved = {}
    for name in ("Picture", "Checkpoint", "Run file", "Animation", "Film"):
        with tab.expect_download(timeout=2e3 * PATIENCE) as download:
            tab.get_by_role("button", name=name, exact=True).click()
            if name in ("Animation", "Film"):
                until(lambda: re.search(r"frame ([2-9]|\d\d)", page.session.note), "frames are made")
                tab.get_by_role("button", name="Stop").click()
        saved[name] = tmp_path / download.value.suggested_filename
        download.value.save_as(saved[name])
    picture = np.asarray(Image.open(saved["Picture"]))
    assert picture.shape == (720, 1280, 3)
    assert 10_000 < colored(Image.open(saved["Picture"])).sum() < 600_000
    assert wc.Simulation.load(saved["Checkpoint"]).body.element_count == page.sim.body.element_count
    assert tomllib.loads(saved["Run file"].read_text()) == {"input": "box"}
    from pxr import Usd

    stage = Usd.Stage.Open(str(saved["Animation"]))
    assert stage.GetEndTimeCode() >= 2
    assert saved["Film"].suffix in (".mp4", ".gif")
    assert saved["Film"].stat().st_size > 1000


@pytest.mark.parametrize("page", [{"token": "open sesame"}], indirect=True)
def test_without_the_token_there_is_no_page(chromium, page, tmp_path):
    context = chromium.new_context(viewport=TAB)
    tab = context.new_page()
    closed = page.address.partition("?")[0]
    for address in (closed, f"{closed}?token=wrong"):
        assert tab.goto(address).status == 403
        assert "The page is closed" in tab.inner_text("body")
    opened = tab.evaluate(
        """address => new Promise(done => { const socket = new WebSocket(address);
        socket.onopen = () => done(true); socket.onerror = () => done(false) })""",
        closed.replace("http", "ws"),
    )
    assert opened is False
    tab.goto(page.address)
    tab.get_by_text("× real time").wait_for(timeout=1e3 * PATIENCE)
    assert "token" not in tab.url
    tab.reload()
    tab.get_by_text("× real time").wait_for(timeout=1e3 * PATIENCE)
    context.close()
