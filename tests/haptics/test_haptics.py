"""The haptic loop: energy through the device, the rendered stiffness, failures, and clean ends."""

import logging
import sys
import time

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.haptics import DeviceError, HapticLoop, MouseDevice, ScriptedDevice
from warp_corot.haptics.exchange import LocalModel, PassivityControl, ToolState

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
RADIUS, TOP = 0.01, 0.02
BOUND, RATE = 1e-3, 1000


def scene(device, viscosity=3e-3):
    """A block 4 x 4 x 2 cm that is fixed below, and a sphere that touches it from above."""
    mesh = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.02, level=3)
    body = wc.SoftBody(mesh, SOFT, device=device)
    body.fix("z == zmin")
    tool = wc.Tool(wc.Sphere(RADIUS, position=(0.02, 0.02, TOP + RADIUS)), speed=2.0)
    integrator = wc.SymplecticEuler(viscosity=viscosity)
    return wc.Simulation(body, obstacles=[tool], gravity=(0, 0, 0), integrator=integrator), tool


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def presses(depths, times):
    """Keyframes of a sphere above the middle of the block."""
    return [(0.02, 0.02, TOP + RADIUS - depth) for depth in depths], times


def run_slowly(sim, loop, clock, seconds, every, pace=1.0):
    """Readings at 1 kHz, and a simulation that publishes once in ``every`` seconds; ``pace`` of simulated over clock
    time."""
    loop.connect()
    per = round(every * RATE)
    for reading in range(round(seconds * RATE)):
        clock.now = reading / RATE
        loop.tick(clock.now)
        if reading % per == per - 1:
            sim.advance(pace * every)
    return loop


def work_of(felt):
    """The cumulated energy put out at each reading [J], by a force that is held while the hand moves on."""
    values = np.array(felt)
    way = np.diff(values[:, 1:4], axis=0)
    return np.cumsum(np.einsum("kx,kx->k", values[:-1, 4:7], way))


# --- energy --------------------------------------------------------------------------------------------------------


def slow_wall(controlled, *, stiffness=1000.0, every=50, seconds=5.0):
    """A wall that is computed at 20 Hz with a delay of one period, and a hand that moves in and out at 2 Hz."""
    control = PassivityControl(BOUND, 1e-3, 1e-2)
    model = LocalModel(stiffness, 1e9)
    none, felt, before, seen = np.zeros(3), [], None, None
    for reading in range(round(seconds * RATE)):
        at = np.array([0.0, 0.0, 0.005 * np.cos(4 * np.pi * reading / RATE)])
        moved = none if before is None else at - before
        if reading % every == 0:
            if seen is not None:
                push = np.array([0.0, 0.0, max(-stiffness * seen[2], 0.0)])
                model.follow(ToolState(reading, 0.0, 0.0, seen, none, push, none))
            seen = at
        control.observe(moved, none, 1 / RATE)
        model.stiffness = 0.0  # the force is only held: what makes energy
        force = model.forces(at)[0]
        if controlled:
            force = control.control(force, none, moved, none)[0]
        felt.append((reading / RATE, *at, *force))
        before = at
    return np.array(felt), control


def test_a_slow_wall_makes_energy_and_control_bounds_it():
    out, _ = slow_wall(controlled=False)
    assert work_of(out)[-1] > 0.05  # what is to be prevented
    felt, control = slow_wall(controlled=True)
    out = work_of(felt)
    assert (out <= BOUND * (1.0 + felt[1:, 0]) + 1e-12).all()
    assert out.max() == pytest.approx(control.most_put_out, rel=1e-9)
    assert np.linalg.norm(felt[:, 4:7], axis=1).max() > 1.0  # it is felt all the same


def test_torques_put_out_bounded_energy():
    """A torque that turns the hand puts out energy only until none is left."""
    control, none, turned = PassivityControl(BOUND, 1e-3, 1e-2), np.zeros(3), np.array([5e-3, 0.0, 0.0])
    out = 0.0
    for reading in range(1000):
        control.observe(none, turned if reading else none, 1 / RATE)
        torque = control.control(none, np.array([0.1, 0.0, 0.0]), none, turned)[1]
        out += float(torque @ turned)
        assert out <= BOUND * (1.0 + reading / RATE) + 1e-12


def test_forces_that_take_energy_are_not_changed():
    control, none = PassivityControl(BOUND, 1e-3, 1e-2), np.zeros(3)
    depth = 0.0
    for _ in range(200):
        depth += 1e-5
        control.observe(np.array([0.0, 0.0, -1e-5]), none, 1 / RATE)
        force = np.array([0.0, 0.0, 800.0 * depth])
        assert (control.control(force, none, np.array([0.0, 0.0, -1e-5]), none)[0] == force).all()
    assert control.damped == 0


@pytest.mark.parametrize("every", [0.02, 0.1])
def test_a_slow_simulation_puts_out_no_more_energy_than_the_bound(device, every):
    """The hand presses 3 mm in and out at 3 Hz against tissue that is published 50 or 10 times a second, at half of the
    clock's pace."""
    sim, tool = scene(device)
    times = np.linspace(0.0, 1.0, 101)
    clock = Clock()
    hand = ScriptedDevice(times, presses(0.003 * np.sin(3 * np.pi * times) ** 2, times)[0], clock=clock)
    loop = HapticLoop(sim, tool, hand, energy_bound=BOUND)
    run_slowly(sim, loop, clock, 1.0, every, pace=0.5)
    felt = hand.felt
    assert (work_of(felt) <= BOUND * (1.0 + felt[1:, 0]) + 1e-12).all()
    assert felt[:, 6].max() > 0.1
    assert loop.report.beyond == 0
    assert loop.report.put_out == pytest.approx(work_of(felt).max(), abs=1e-9)


# --- stiffness -----------------------------------------------------------------------------------------------------


def test_the_rendered_stiffness_is_that_of_the_tissue(device):
    """The tissue is pressed slowly; the reference holds the same tool at several depths, without a loop."""
    depths = np.array([0.001, 0.0015, 0.002])
    sim, tool = scene(device)
    held = []
    for depth in depths:
        tool.move((0.02, 0.02, TOP + RADIUS - depth))
        sim.advance(0.1)
        samples = []
        for _ in range(10):
            sim.advance(0.002)
            samples.append(float(tool.wrench.numpy()[0][2]))
        held.append(np.mean(samples))
    sim, tool = scene(device)
    clock = Clock()
    hand = ScriptedDevice([0.0, 1.0], presses([0.0, 0.0022], None)[0], clock=clock)
    loop = HapticLoop(sim, tool, hand)
    run_slowly(sim, loop, clock, 1.0, 0.005)
    felt = hand.felt
    depth = TOP + RADIUS - felt[:, 3]
    at = np.array([felt[np.abs(depth - each) < 3e-5, 6].mean() for each in depths])
    np.testing.assert_allclose(at, held, rtol=0.03)
    slope, expected = np.polyfit(depths, at, 1)[0], np.polyfit(depths, held, 1)[0]
    assert slope == pytest.approx(expected, rel=0.04)
    assert loop.report.stiffness == pytest.approx(expected, rel=0.2)
    assert loop.report.damped == 0


def test_the_local_model_finds_a_springs_stiffness_and_continues_with_it():
    model, none = LocalModel(100.0, 1e5), np.zeros(3)
    for count in range(1, 60):
        at = np.array([0.0, 0.0, -1e-5 * count])
        model.follow(ToolState(count, 0.0, 0.0, at, none, np.array([0.0, 0.0, 700.0 * 1e-5 * count]), none))
    assert model.stiffness == pytest.approx(700.0, rel=0.1)
    deeper = at - np.array([0.0, 0.0, 5e-4])
    assert model.forces(deeper)[0][2] == pytest.approx(-700.0 * deeper[2], rel=0.05)
    assert (model.forces(np.array([0.0, 0.0, 0.01]))[0] == 0.0).all()  # it never pulls
    model.follow(ToolState(60, 0.0, 0.0, at, none, none, none))
    assert (model.forces(at)[0] == 0.0).all()


# --- the thread ----------------------------------------------------------------------------------------------------


def test_a_tool_follows_the_hand_and_the_thread_ends(device):
    sim, tool = scene(device)
    hand = MouseDevice((0.02, 0.02, TOP + RADIUS))
    interval = sys.getswitchinterval()
    with HapticLoop(sim, tool, hand) as loop:
        hand.move((0.02, 0.02, TOP + RADIUS - 0.002))
        end = time.monotonic() + 60.0
        while sim.total_time < 0.05 and time.monotonic() < end:
            loop.run(0.2)
        assert loop.is_running
    assert not loop.is_running
    assert loop.error is None
    np.testing.assert_allclose(tool.present_pose[0, :3], (0.02, 0.02, TOP + RADIUS - 0.002), atol=1e-6)
    assert tool.wrench.numpy()[0][2] > 0.1
    assert (hand.force == 0.0).all()  # nothing pushes when the loop has ended
    report = loop.report
    assert report.readings > 10
    assert report.updates > 1
    assert report.delay > 0.0
    assert sys.getswitchinterval() == interval
    assert loop._exchange not in sim.system.constraints
    loop.stop()
    sim.advance(0.005)  # goes on without the loop
    with pytest.raises(wc.InputError, match="started before"):
        loop.start()


def test_a_report_without_readings_says_so():
    sim, tool = scene("cpu")
    said = str(HapticLoop(sim, tool, MouseDevice((0.02, 0.02, TOP + RADIUS))).report)
    assert said.count("not measured yet") == 2
    assert "nan" not in said


def test_the_first_state_does_not_count_as_run_time(monkeypatch):
    """For the first one kernels may be compiled for longer than the run."""
    sim, tool = scene("cpu")
    advance, naps = sim.advance, [0.3]
    monkeypatch.setattr(sim, "advance", lambda every: (time.sleep(naps.pop() if naps else 0.0), advance(every)))
    with HapticLoop(sim, tool, MouseDevice((0.02, 0.02, TOP + RADIUS))) as loop:
        loop.run(0.1, every=0.002)
    assert sim.total_time > 0.003


class Failing(MouseDevice):
    """A device that is unplugged at the third reading, or at the third force."""

    def __init__(self, method):
        super().__init__((0.02, 0.02, 0.2))
        self.method, self.left, self.last = method, 3, None

    def _count(self, method):
        if method == self.method:
            self.left -= 1
            if self.left <= 0:
                raise ConnectionError("unplugged\nat the wall")

    def read(self):
        self._count("read")
        return super().read()

    def write(self, force, torque):
        self.last = force
        self._count("write")


@pytest.mark.parametrize("method", ["read", "write"])
def test_a_device_that_fails_stops_the_loop_with_one_line(method, caplog):
    sim, tool = scene("cpu")
    with caplog.at_level(logging.ERROR), HapticLoop(sim, tool, Failing(method)) as loop:
        loop._thread.join(10.0)
        assert not loop.is_running
        with pytest.raises(DeviceError, match="unplugged at the wall"):
            loop.run(0.01)
    (record,) = caplog.records
    assert (
        record.getMessage() == "the haptic device failed: ConnectionError: unplugged at the wall; the loop has stopped"
    )
    sim.advance(0.001)


@pytest.mark.parametrize("reading", [((0, 0, np.nan), (0, 0, 0, 1)), ((0, 0), (0, 0, 0, 1)), ((0, 0, 0), (0, 0, 0, 0))])
def test_invalid_readings_stop_the_loop(reading, caplog):
    sim, tool = scene("cpu")
    hand = MouseDevice()
    hand._pose = reading
    with HapticLoop(sim, tool, hand) as loop:
        loop._thread.join(10.0)
        assert "three finite numbers" in loop.error


def test_the_force_of_a_simulation_that_stops_fades():
    sim, tool = scene("cpu")
    clock = Clock()
    hand = ScriptedDevice([0.0, 0.1], presses([0.0, 0.002], None)[0], clock=clock)
    loop = HapticLoop(sim, tool, hand)
    run_slowly(sim, loop, clock, 0.15, 0.005)
    assert hand.felt[-1][6] > 0.1
    for reading in range(150, 700):
        clock.now = reading / RATE
        loop.tick(clock.now)
    assert hand.felt[-1][6] == 0.0


def test_states_are_never_half_written():
    """A state that is written while it is read is read again, and a count that did not change is no new state."""
    sim, tool = scene("cpu")
    loop = HapticLoop(sim, tool, MouseDevice((0.02, 0.02, 0.2)))
    loop.connect()
    exchange = loop._exchange
    assert exchange.newest(None) is None
    sim.advance(0.001)
    first = exchange.newest(None)
    assert exchange.newest(first) is first
    assert first.time == pytest.approx(sim.total_time)

    class Torn:
        """Changes the count after each look at a slot, as if a state were being written."""

        def __init__(self, values):
            self.values, self.looks = values, 0

        def __getitem__(self, key):
            if isinstance(key, slice):
                self.looks += 1
                if self.looks == 1:
                    sim.advance(0.001)
                    sim.advance(0.001)
            return self.values[key]

    torn = Torn(exchange._shared.values)
    exchange._shared.values = torn
    state = exchange.newest(None)
    assert torn.looks == 2
    assert state.count == int(torn.values[0])
    assert state.time == pytest.approx(sim.total_time)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sim": 3}, "Simulation"),
        ({"tool": wc.Tool(wc.Sphere(0.1))}, "among the simulation's obstacles"),
        ({"device": 3}, "read"),
        ({"rate": 0.0}, "rate"),
        ({"energy_bound": -1.0}, "energy_bound"),
        ({"stiffness": np.nan}, "stiffness"),
        ({"most_force": "much"}, "most_force"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, says):
    sim, tool = scene("cpu")
    given = {"sim": sim, "tool": tool, "device": MouseDevice(), **change}
    with pytest.raises(wc.InputError, match=says) as caught:
        HapticLoop(given.pop("sim"), given.pop("tool"), given.pop("device"), **given)
    assert "\n" not in str(caught.value)


def test_scripts_are_checked():
    with pytest.raises(wc.InputError, match="times"):
        ScriptedDevice([1.0, 0.0], [(0, 0, 0), (0, 0, 1)])
    with pytest.raises(wc.InputError, match="positions"):
        ScriptedDevice([0.0, 1.0], [(0, 0, 0), (0, 0, np.nan)])
    with pytest.raises(wc.InputError, match="position"):
        MouseDevice().move((0, 0, np.inf))
