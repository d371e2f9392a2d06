"""A slab is pulled and pressed at random for long: nothing is lost, nothing grows, nothing breaks."""

import gc
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from remesh_cases import assert_sound

import warp_corot as wc
from warp_corot.kernels.remesh.criteria import strain

SIDE = 0.5  # of a root cube [m]; large and soft, so that steps are long
CELLS = (4, 1, 4)
RADIUS = 0.3  # of a patch [m]


class Ordeal:
    """A slab on the floor; every second it is pushed or dragged at another place, and the dragged part is released."""

    def __init__(self, device, seed):
        self.rng = np.random.default_rng(seed)
        mesh = wc.TetForest.box(CELLS, SIDE, 3)
        self.body = wc.SoftBody(mesh, wc.Isotropic(young=2e3, poisson=0.35, density=1000.0), device=device)
        self.body.fix(mesh.points[:, 1] < 1e-9)
        self.remesh = wc.OnlineRemesh(
            criterion=strain,
            parameters=wp.array([SIDE / 2], dtype=wp.float32, device=device),
            refine_above=0.2,
            simplify_below=0.08,
            min_level=3,
            max_level=9,
            every=5,
            capacity=40_000,
        )
        self.place, self.pull = np.zeros(2), np.zeros(3)  # the pull in metres per second squared
        self.seconds = 0
        self.sim = wc.Simulation(
            self.body, integrator=wc.SymplecticEuler(damping=2.0), gravity=(0, -0.2, 0), remesh=self.remesh
        )
        self.sim.on_step(self.push, every=5)

    def second(self):
        body, mesh = self.body, self.body.mesh
        x = mesh.points
        body.release(body.constrained & (x[:, 1] > 1e-9))
        self.place = self.rng.uniform(0.0, 4 * SIDE, 2)
        self.pull = np.zeros(3)
        if self.rng.random() < 0.6:
            self.pull = self.rng.uniform(-1.0, 1.0, 3) * [2.0, 4.0, 2.0]
        else:
            top = np.flatnonzero(x[:, 1] > SIDE - 1e-9)
            patch = top[self.distance(x[top]) <= RADIUS]
            u = body.displacements.numpy()[patch]
            way = self.rng.uniform(-1.0, 1.0, 3) * [0.2, 0.25, 0.2] * SIDE
            times = self.sim.time + np.array([0.0, 0.5, 1.0])
            body.prescribe(patch, times=times, displacements=[u, 0.5 * u + way, u])
        self.seconds += 1
        self.sim.advance_until(self.seconds)

    def push(self, sim):
        """Load the current nodes near the place."""
        body = self.body
        share = np.maximum(1.0 - (self.distance(body.positions.numpy()) / RADIUS) ** 2, 0.0)
        body.load(np.arange(body.node_count), share[:, None] * body.masses[:, None] * self.pull)

    def distance(self, x):
        return np.linalg.norm(x[:, [0, 2]] - self.place, axis=1)


def resident(device):
    """Memory in use, of the process or of Warp on the device [B]."""
    gc.collect()
    if wp.get_device(device).is_cuda:
        wp.synchronize_device(device)
        return wp.get_mempool_used_mem_current(device)
    return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads what memory is in use from /proc")
@pytest.mark.parametrize("seconds", [5, pytest.param(3600, marks=pytest.mark.slow)])
def test_pulled_and_pressed_at_random(seconds, device):
    """The state is finite, or ``advance`` reports it; mass to rounding; balanced pools; volume; constant memory."""
    ordeal = Ordeal(device, seed=5)
    body, sim = ordeal.body, ordeal.sim
    mass, volume = body.masses.sum(), body.mesh.volumes.sum()
    counts, memory = [], []
    for second in range(seconds):
        ordeal.second()
        counts.append(body.element_count)
        if second % max(seconds // 30, 1) == 0:
            assert_sound(body.changing.forest)
            assert np.isfinite(body.positions.numpy()).all()
            assert body.masses.sum() == pytest.approx(mass, rel=1e-12)
            assert body.conditions.mass.numpy()[: body.node_count].sum(dtype=float) == pytest.approx(mass, rel=1e-6)
            assert body.mesh.volumes.sum() == pytest.approx(volume, rel=1e-12)
            assert body.masses.min() > 0
            memory.append(resident(device))
    print(f"{sim.total_steps} steps, {body.version} meshes of {min(counts)} to {max(counts)} elements")
    print("memory [MB]", [m >> 20 for m in memory])
    assert sim.total_time == pytest.approx(seconds, abs=sim.dt)
    assert max(counts) > 3 * min(counts)
    assert not body.changing.is_full
    # The first third fills caches; after that nothing grows with the number of meshes.
    steady = np.array(memory[len(memory) // 3 :], dtype=float)
    growth = np.polyfit(np.linspace(0.0, 1.0, len(steady)), steady, 1)[0]
    assert growth < 4 << 20
