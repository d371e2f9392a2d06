"""Criteria and bodies that are refused before anything changes, and the warning of a full mesh."""

import pytest
import warp as wp
from remeshed import SOFT, bar, near

import warp_corot as wc
from warp_corot.kernels.remesh.criteria import ElementState, nearness, strain, von_mises_stress


@wp.func
def of_one_argument(element: ElementState):
    return 1.0


@wp.func
def that_returns_nothing(element: ElementState, parameters: wp.array[wp.float32]):
    parameters[0] = 1.0


def test_criteria_that_cannot_work_are_named(device):
    """A kernel would silently read beyond an array that is too short."""

    def numbers(count, where=device):
        return wp.zeros(count, dtype=wp.float32, device=where)

    for criterion, parameters, said in [
        (of_one_argument, None, "criterion is 'of_one_argument', which takes 1 arguments; it must take two"),
        (wp.sin, None, "it must be a Warp function"),
        (strain, None, "parameters has 0 numbers; it must have 1, which the criterion 'strain' reads"),
        (
            von_mises_stress,
            None,
            "parameters has 0 numbers; it must have 1, which the criterion 'von_mises_stress' reads",
        ),
        (nearness, numbers(7), "parameters has 7 numbers; it must have 8, which the criterion 'nearness' reads"),
        (strain, numbers(0), "not empty"),
        (None, numbers(0), "not empty"),
    ]:
        with pytest.raises(wc.InputError, match=said):
            wc.OnlineRemesh(criterion=criterion, parameters=parameters)
    body = bar(device)
    with pytest.raises(wc.InputError, match=r"'that_returns_nothing' does not compile: .*NoneType"):
        wc.Simulation(body, remesh=wc.OnlineRemesh(criterion=that_returns_nothing))
    if not body.device.is_cpu:
        remesh = wc.OnlineRemesh(criterion=nearness, parameters=numbers(8, "cpu"))
        with pytest.raises(wc.InputError, match="parameters is on cpu; it must be on the body's device, cuda"):
            wc.Simulation(body, remesh=remesh)
    assert body.changing is None


def test_what_is_refused_leaves_all_bodies_as_they_are(device):
    body = bar(device)
    general = wc.SoftBody(wc.TetMesh(body.mesh.points, body.mesh.tets), SOFT, device=device)
    with pytest.raises(wc.InputError, match="the mesh of this body is a TetMesh"):
        wc.Simulation([body, general], remesh=wc.OnlineRemesh())
    wc.Simulation([body, general], remesh=[wc.OnlineRemesh(), None]).step()


@pytest.mark.parametrize(
    "go", [lambda sim: sim.step(), lambda sim: sim.advance(sim.dt), lambda sim: sim.advance_steps(1)]
)
def test_a_full_mesh_warns_at_the_users_line(go, device):
    body = bar(device)
    sim = wc.Simulation(body, remesh=near(0.1, device, every=1, capacity=body.element_count))
    with pytest.warns(wc.CapacityWarning) as said:
        go(sim)
    assert [warning.filename for warning in said] == [__file__]
