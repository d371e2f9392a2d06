"""A soft blade in a gusty wind, as part of a JAX program: steps are an operation inside `jit` and `scan`.

The wind, a JAX function of place and time, gives the forces, and the steps give the positions a millisecond later, in
JAX's buffers and without a copy. The velocities stay in the simulation, and the operation has no gradient.
"""

import argparse

import numpy as np
import warp as wp

import warp_corot as wc
from warp_corot.io.write.usd.writer import UsdWriter

try:
    import jax
    import jax.numpy as jnp
except ImportError:
    raise SystemExit('this example needs JAX: pip install "warp-corot[jax]"') from None

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="with_jax.usd")
parser.add_argument("--duration", type=float, default=3.0, help="seconds simulated")
args = parser.parse_args()

FPS, DRAG = 24, 5e-5  # DRAG: of a node [N s/m]
mesh = wc.TetForest.box(cells=(2, 12, 1), cell_size=0.01, level=3)
body = wc.SoftBody(mesh, wc.Isotropic(young=1e5, poisson=0.4, density=500.0), device=args.device)
body.fix(mesh.points[:, 1] < 1e-9)
sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=3.0))
steps = round(1e-3 / sim.dt)  # with the same wind
calls = round(1.0 / (FPS * steps * sim.dt))  # a frame


def advance(forces: wp.array(dtype=wp.vec3), positions: wp.array(dtype=wp.vec3)):
    body.use_loads(forces)
    body.use_positions(positions)
    for _ in range(steps):
        sim.step()
    body.use_loads(None)  # JAX reuses its buffers
    body.use_positions(None)


advanced = wp.jax_callable(advance, output_dims=body.node_count, has_side_effect=True)


def blow(x, t):
    """Positions [N, 3] a millisecond later, in gusts that travel upwards."""
    wind = (1.0 + jnp.sin(7.0 * t - 20.0 * x[:, 1:2]) + 0.5 * jnp.sin(23.0 * t)) * jnp.array([0.2, 0.0, 3.0])  # [m/s]
    return *advanced(DRAG * wind), None


frame = jax.jit(lambda x, times: jax.lax.scan(blow, x, times)[0])
with jax.default_device(wp.device_to_jax(body.device)), UsdWriter(args.output, mesh, fps=FPS) as writer:
    x = jnp.asarray(mesh.points, jnp.float32)
    for k in range(round(args.duration * FPS) + 1):
        writer.write(now := np.asarray(x))
        if k % 6 == 0:
            print(f"{k / FPS:5.2f} s   tip {1e3 * (now - mesh.points)[-1, 2]:5.1f} mm to the lee")
        x = frame(x, (k + jnp.arange(calls) / calls) / FPS)
print(f"wrote {args.output}")
