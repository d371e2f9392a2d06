"""Bodies whose meshes follow the motion, and their references."""

import warp as wp

import warp_corot as wc
from warp_corot.kernels.remesh.criteria import ElementState

SOFT = wc.Isotropic(young=3e4, poisson=0.4, density=1000.0)


@wp.func
def nearness(element: ElementState, parameters: wp.array[wp.float32]):
    """Nearness of the first corner to a plane x = parameters[0], in units of parameters[1]."""
    return parameters[1] / (1.0e-6 + wp.abs(element.corner[0] - parameters[0]))


def bar(device, level=6, **material):
    body = wc.SoftBody(wc.TetForest.box((4, 1, 1), 0.05, level), wc.Isotropic(**_values(material)), device=device)
    body.fix(body.mesh.points[:, 0] < 1e-9)
    return body


def _values(changes):
    return {"young": 3e4, "poisson": 0.4, "density": 1000.0} | changes


def near(x, device, **options):
    """Remeshing that refines around x, and simplifies elsewhere."""
    parameters = wp.array([x, 0.02], dtype=wp.float32, device=device)
    values = {"refine_above": 1.0, "simplify_below": 0.5, "min_level": 3, "max_level": 9, "every": 5}
    return wc.OnlineRemesh(criterion=nearness, parameters=parameters, **(values | options))


def twin(body, model, sim):
    """An independent body of fixed topology in the same state, and its simulation."""
    other = wc.SoftBody(body.mesh, body.material, device=body.device)
    other.fix(body.constrained)
    other.displacements = body.displacements
    other.velocities = body.velocities.numpy()
    if body.conditions.has_loads:
        wp.copy(other.loads, body.loads)
    return wc.Simulation(other, model=model, integrator=wc.SymplecticEuler(dt=sim.dt, damping=1.0), gravity=sim.gravity)
