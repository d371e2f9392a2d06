"""Kernels that are compiled together."""

import warp as wp

from warp_corot.kernels.elements import dilatation as kernels
from warp_corot.kernels.elements.dilatation import SMALL, VOLUME
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements


def test_kernels_of_a_family_are_one_module_for_each_law_and_kind():
    made = [kernels.measure_elements(kind, of) for kind in (ForestElements, GeneralElements) for of in (SMALL, VOLUME)]
    assert len({kernel.module.name for kernel in made}) == 4
    module = kernels.unshare(ForestElements, VOLUME).module
    assert module is kernels.measure_elements(ForestElements, VOLUME).module
    assert len(module.kernels) == 4
    assert kernels.measure_elements(ForestElements, VOLUME) is made[1]
    assert not any(kernel.options["enable_backward"] for kernel in module.kernels.values())
    assert isinstance(module, wp.Module)
