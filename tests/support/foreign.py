"""Shared helpers for other programs' arrays: a body, arrays of every form, slow work."""

import io

import numpy as np
import warp as wp

import warp_corot as wc

RUBBER = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
DT = 2e-4
SIDE = np.array([0.25, -0.5, 0.125])  # a direction that float32 represents exactly [m]


def bar(device, *, level=3, worlds=1, gravity=(0.0, 0.0, 0.0), fixed=True, model=None, damping=5.0):
    """A simulation of a small bar whose results are reproducible bit for bit."""
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=level)
    body = wc.SoftBody(mesh, RUBBER, worlds=worlds, device=device)
    if fixed:
        body.fix(mesh.points[:, 2] < 1e-9)
    integrator = wc.SymplecticEuler(dt=DT, damping=damping)
    return wc.Simulation(body, model=model, integrator=integrator, gravity=gravity, deterministic=True)


@wp.kernel(enable_backward=False)
def dawdle(rounds: int, done: wp.array[wp.float32]):
    """One thread that takes a while, and whose result cannot be predicted."""
    x = done[0]
    for _ in range(rounds):
        x = wp.sin(x) + 1.0
    done[0] = x


def vec3(n, device):
    return wp.zeros(n, dtype=wp.vec3, device=device)


def vec3_among_others(n, device):
    """Three of seven numbers, as in a particle's record."""
    return wp.full((n, 7), 3.25, dtype=wp.float32, device=device)[:, 2:5].view(wp.vec3)


def vec4(n, device):
    return wp.full(n, wp.vec4(0.0, 0.0, 0.0, 3.25), dtype=wp.vec4, device=device)


def vec4_between_words(n, device):
    """Vectors that do not start at multiples of 16 bytes."""
    numbers = wp.full(4 * n + 1, 3.25, dtype=wp.float32, device=device)
    return numbers[1:].reshape((n, 4)).view(wp.vec4)


def rows_of_three(n, device):
    return wp.zeros((n, 3), dtype=wp.float32, device=device)


def rows_of_four(n, device):
    return wp.full((n, 4), 3.25, dtype=wp.float32, device=device)


FORMS = [vec3, vec3_among_others, vec4, vec4_between_words, rows_of_three, rows_of_four]


def three_of(array):
    """The first three numbers of each vector as a live vec3 array."""
    numbers = array if array.dtype == wp.float32 else array.view(wp.float32)
    return numbers[:, :3].view(wp.vec3)


def write(array, vectors):
    """Write vectors [n, 3] into an array of any form, and leave everything else in it unchanged."""
    whole = array.numpy().copy()
    whole[..., :3] = np.reshape(vectors, (*whole.shape[:-1], 3))
    array.assign(whole)


def read(array):
    """The vectors in an array of any form, [n, 3]."""
    return array.numpy()[..., :3].reshape(-1, 3).copy()


def allocates(work):
    """Whether work allocates memory through Warp, on any device."""
    with wp.ScopedMemoryTracker(print=False) as tracker:
        before = _totals(tracker)
        work()
        return _totals(tracker) != before


def _totals(tracker):
    """Number and amount of allocations so far: one line for each device."""
    text = io.StringIO()
    tracker.report(file=text)
    lines = text.getvalue().splitlines()
    return lines[lines.index("  Total allocations:") : lines.index("  Peak usage:")]
