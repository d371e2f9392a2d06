"""PyTorch holds up sixteen soft beams: the steps read forces from one tensor and write positions to another.

Nothing is copied, and no value passes through the host. Each beam has a damped spring of a different stiffness at its
tip, written as tensor code for all beams at once. It needs `pip install "warp-corot[torch]"`.
"""

import argparse

import warp as wp

import warp_corot as wc

try:
    import torch
except ImportError:
    raise SystemExit('this example needs PyTorch: pip install "warp-corot[torch]"') from None

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="with_pytorch.usd")
parser.add_argument("--duration", type=float, default=2.0, help="seconds simulated")
args = parser.parse_args()

BEAMS = 16
mesh = wc.TetForest.box(cells=(1, 1, 4), cell_size=0.03, level=3)
body = wc.SoftBody(mesh, wc.Isotropic(young=2e4, poisson=0.45, density=1000.0), worlds=BEAMS, device=args.device)
body.fix(mesh.points[:, 2] < 1e-9)
sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=2.0))

device = wp.device_to_torch(body.device)
forces = torch.zeros(BEAMS, len(mesh.points), 3, device=device)  # [N]
positions = torch.empty_like(forces)  # [m]
body.use_loads(wp.from_torch(forces))
body.use_positions(wp.from_torch(positions))  # written at once, and after each step
velocities = wp.to_torch(body.velocities).view(BEAMS, -1, 3)  # in the other direction: the body's own array

tip = torch.as_tensor(mesh.points[:, 2] > 0.12 - 1e-9, device=device)
goal = positions[:, tip].mean(dim=1)
stiffness = torch.logspace(-1, 2, BEAMS, device=device)[:, None]  # [N/m]
damping = 0.02 * stiffness.sqrt()  # [N s/m]


def hold(sim):
    x, v = positions[:, tip].mean(dim=1), velocities[:, tip].mean(dim=1)
    force = stiffness * (goal - x) - damping * v
    forces[:, tip] = (force / tip.sum())[:, None]


sim.on_step(hold, every=round(1e-3 / sim.dt))
wc.record(sim, args.output, duration=args.duration, world=BEAMS // 2)
sag = (goal - positions[:, tip].mean(dim=1))[:, 1]
for k, s in zip(stiffness[:, 0].tolist(), sag.tolist(), strict=True):
    print(f"spring of {k:6.2f} N/m   sag {1e3 * s:5.2f} mm")
print(f"wrote {args.output}")
