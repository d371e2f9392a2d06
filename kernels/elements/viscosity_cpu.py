"""Viscous forces on the CPU: eight elements, of a forest or general ones, in the lanes of vector registers; see
``lanes`` and ``viscosity``."""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import FRAME_SHIFT, MIRROR_BIT, VOLUME, column_sums, force_sums

from .constitutive import IsotropicMaterial
from .elements import LEVEL_MASK, ForestElements
from .lanes import COMPILER_FLAGS, LANES, constants, native, on_cpu
from .law_lanes import ROTATION
from .viscosity import LEAST, add_viscous_forces

wp.set_module_options({"enable_backward": False})


@wp.struct
class ViscousMaterial:
    """Lamé's parameters [Pa], viscosities over these [s], and the velocities of nodes [m/s]."""

    isotropic: IsotropicMaterial
    seconds: float
    velocities: wp.array[wp.vec4]


@functools.cache
def scatter_viscous_eights(Elements: type) -> wp.Kernel:
    """Add viscous nodal forces to f; a thread is eight elements."""
    gathering = _forest() if Elements is ForestElements else native("eights", "rest_elements", "general_eights")
    code = constants(LEAST=float(LEAST)) + ROTATION + gathering + native("viscous", "viscous_elements")

    @wp.func_native(on_cpu(code, otherwise="return 0;\n"))
    def eight_elements(
        units: Elements, block: int, count: int, material: ViscousMaterial, u: wp.array[wp.vec4], f: wp.array[wp.vec4]
    ) -> int: ...

    @unique_kernel(COMPILER_FLAGS)
    def scatter_viscous_eights(
        # In
        elements: Elements,
        count: int,
        material: ViscousMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        block = wp.tid()
        left_out = eight_elements(elements, block, count, material, u, f)
        lane = int(0)
        while left_out != 0:
            if (left_out & 1) != 0:
                t = LANES * block + lane
                add_viscous_forces(elements, t, material.seconds, material.isotropic, u, material.velocities, f)
            left_out >>= 1
            lane += 1

    return scatter_viscous_eights


def _forest() -> str:
    """Native code that gathers eight elements of a forest; ``columns`` and ``forces_of`` choose by their types."""
    names = {"FRAME_SHIFT": FRAME_SHIFT, "MIRROR_BIT": MIRROR_BIT, "LEVEL_MASK": LEVEL_MASK}
    columns = "".join(
        f"    a[{c}] = ({_by_type(sums)}) * inverse_h;\n" for c, sums in enumerate(_of_types(column_sums))
    )
    forces = "".join(f"    force[{n}] = {_by_type(sums)};\n" for n, sums in enumerate(_of_types(force_sums)))
    volume = "is_type2 ? spread({2!r}f) : is_type1 ? spread({1!r}f) : spread({0!r}f)".format(*VOLUME)
    return (
        constants(**{name: int(value) for name, value in names.items()})
        + native("eights", "forest_eights")
        + f"const lanes8 inverse_h = 1.0f / h, weight = h * h * ({volume});\n"
        + "const auto columns = [&](const triple* x, triple* a) {\n"
        + "    const triple &x0 = x[0], &x1 = x[1], &x2 = x[2], &x3 = x[3];\n"
        + f"{columns}}};\n"
        + "const auto forces_of = [&](const triple* p, triple* force) {\n"
        + "    const triple &p0 = p[0], &p1 = p[1], &p2 = p[2];\n"
        + f"{forces}}};\n"
    )


def _of_types(sums: object) -> list[tuple[str, ...]]:
    return list(zip(*(sums(shape) for shape in range(3)), strict=True))  # type: ignore[operator]


def _by_type(expressions: tuple[str, ...]) -> str:
    of0, of1, of2 = expressions
    others = of0 if of0 == of1 else f"chosen(is_type1, {of1}, {of0})"
    return f"chosen(is_type2, {of2}, {others})"
