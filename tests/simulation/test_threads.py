"""Threads: each has its own simulation; they take turns on the device. Bodies are not copied by accident."""

import copy
import pickle
import threading

import numpy as np
import pytest

import warp_corot as wc


def swinging() -> wc.Simulation:
    mesh = wc.TetForest.box((1, 1, 1), 0.1, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.3, 1e3), device="cpu")
    body.fix("z == zmin")
    return wc.Simulation(body, gravity=(0.0, -9.8, 0.0))


def run(sim: wc.Simulation) -> np.ndarray:
    """Runs of several lengths, each of which is recorded separately, with a user's actions in between."""
    for count in range(1, 20):
        sim.advance_steps(count)
        sim.body.load("z == zmax", (0.0, 1e-3 * count, 0.0))
        sim.step()
    sim.advance(0.05)
    return sim.body.displacements.numpy()


def test_simulations_in_threads_are_those_of_one_thread():
    alone = run(swinging())
    found: list = []
    threads = [threading.Thread(target=lambda: found.append(run(swinging()))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120.0)
    assert len(found) == 4
    for each in found:
        np.testing.assert_array_equal(each, alone)


def test_a_waiting_thread_gets_its_turn():
    """A long run does not keep others from reading its body."""
    sim, read = swinging(), threading.Event()
    ends_early: list[int] = []

    def look() -> None:
        for _ in range(5):
            np.testing.assert_array_equal(np.isfinite(sim.body.displacements.numpy()), True)
        read.set()

    def stop(sim: wc.Simulation) -> None:
        if read.is_set():
            ends_early.append(sim.steps)
            raise StopIteration

    sim.on_step(stop, every=8)
    reader = threading.Thread(target=look)
    reader.start()
    with pytest.raises(StopIteration):
        sim.advance_steps(10**7)
    reader.join(60.0)
    assert ends_early


@pytest.mark.parametrize("take", [copy.copy, copy.deepcopy, pickle.dumps])
def test_bodies_and_simulations_are_not_copied(take):
    sim = swinging()
    with pytest.raises(wc.InputError, match="SoftBody lives on a device"):
        take(sim.body)
    with pytest.raises(wc.InputError, match=r"sim\.save\(path\)"):
        take(sim)


def test_things_without_state_can_be_copied():
    mesh = wc.TetForest.box((1, 1, 1), 0.1, 3)
    for each in (mesh, wc.Isotropic(5e3, 0.3, 1e3), wc.Corotated(), wc.Contact(), wc.BackwardEuler(), mesh.surface()):
        assert type(pickle.loads(pickle.dumps(each))) is type(each)
