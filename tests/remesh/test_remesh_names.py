"""Public names of remeshing in ``wc.remesh``, used as in a user's script."""

from __future__ import annotations  # so that annotations are text, which Warp looks up among the function's globals

import numpy as np
import warp as wp

import warp_corot as wc
from warp_corot.kernels.remesh import criteria

SIZE = 0.064


@wp.func
def strain_of_long_elements(element: wc.remesh.ElementState, parameters: wp.array[wp.float32]):
    """The strain, for elements whose longest edge is longer than the second number."""
    found = wc.remesh.strain(element, parameters)
    if wc.remesh.longest_edge(element) <= parameters[1]:
        found = 0.0
    return found


@wp.func
def stretch_in_x(element: wc.remesh.ElementState, parameters: wp.array[wp.float32]):
    return wc.remesh.displacement_gradient(element)[0, 0] + wc.remesh.green_strain(element)[0, 0]


def elements_after_a_step(criterion, numbers, device, **options):
    """The number for a box of 384 elements, stretched to 1.3 times its length in x."""
    mesh = wc.TetForest.box((1, 1, 1), SIZE, 6)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.45, 1000.0), device=device)
    body.displacements = mesh.points * [0.3, 0.0, 0.0]
    parameters = wp.array(numbers, dtype=wp.float32, device=device)
    remesh = wc.OnlineRemesh(criterion=criterion, parameters=parameters, every=1, **options)
    wc.Simulation(body, gravity=np.zeros(3), remesh=remesh).step()
    return body.element_count


def test_a_users_criterion_needs_only_exported_names(device):
    for name in (
        "strain",
        "von_mises_stress",
        "nearness",
        "longest_edge",
        "green_strain",
        "ElementState",
        "elongation",
    ):
        assert getattr(wc.remesh, name) is getattr(criteria, name)
        assert name in wc.remesh.__all__
    edge = SIZE / 4 * np.sqrt(3.0)  # the longest one of elements of type 0
    limits = {"refine_above": 0.2, "simplify_below": 0.1}
    assert elements_after_a_step(strain_of_long_elements, [SIZE / 4, 0.99 * edge], device, **limits) > 384
    assert elements_after_a_step(strain_of_long_elements, [SIZE / 4, 1.01 * edge], device, min_level=6, **limits) == 384
    # du/dx + (du/dx + (du/dx)^2 / 2) with du/dx = 0.3.
    for refine_above, is_refined in ((0.6, True), (0.7, False)):
        count = elements_after_a_step(
            stretch_in_x, [0.0], device, refine_above=refine_above, simplify_below=0.0, min_level=6
        )
        assert (count > 384) == is_refined
