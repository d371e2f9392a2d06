"""The C++ headers of laws and traversals: each stands by itself, and a law is the same function in every scalar."""

import functools
import math
import shutil
import subprocess

import numpy as np
import oracle
import pytest
import warp as wp

from warp_corot.elasticity import float64
from warp_corot.kernels.elements.simd8 import LAWS, NATIVE, elastic, headers
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import FRAME_SHIFT, LEVEL_BITS, MIRROR_BIT

#: Parts of functions, not headers.
PARTS = ("persistent_cg", "ssor_cg", "sweep_in_registers", "sweep_matrix")
HEADERS = sorted(path.stem for path in NATIVE.glob("*.h") if path.stem not in PARTS)
COMPILER = shutil.which("clang++") or shutil.which("g++")
MU, LAM = 3.0, 7.0


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("name", HEADERS)
def test_a_header_compiles_by_itself(name, tmp_path):
    source = tmp_path / "alone.cpp"
    source.write_text(f'#include "{(NATIVE / f"{name}.h").as_posix()}"\n')
    command = [
        COMPILER,
        "-std=c++17",
        "-fsyntax-only",
        "-Wall",
        "-Werror",
        "-Wno-unknown-pragmas",
        "-Wno-psabi",
        source,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_changed_header_is_compiled_again():
    """Modules depend on every header that they include, directly or not."""
    assert {path.stem for path in headers("subtrees8").extra_build_dependencies} == {
        *("subtrees8", "elements8", "dilatation", "laws", "deformation", "simd8")
    }


def test_numbers_agree_with_the_kernels():
    numbers = "".join((NATIVE / f"{name}.h").read_text() for name in ("laws", "dilatation", "elements8"))
    assert "CONTINUED_BELOW = 0.5f;" in numbers
    assert f"LOG_CONTINUED = {math.log(0.5)!r};" in numbers
    codes = (2**LEVEL_BITS - 1, MIRROR_BIT, FRAME_SHIFT)
    assert "LEVEL_MASK = {}, MIRROR_BIT = {}, FRAME_SHIFT = {}".format(*codes) in numbers


@functools.cache
def stresses(scalar, dtype, law):
    """The kernel that finds the stress P of displacement gradients A under a law, in this scalar."""
    matrix = wp.types.matrix(shape=(3, 3), dtype=dtype)
    expression = elastic(law).code.removeprefix("corot::elastic(").rsplit(", material)", 1)[0]

    snippet = f"""
#if !defined(__CUDA_ARCH__)
    corot::triple<{scalar}> columns[3], p[3];
    for (int j = 0; j < 3; ++j) columns[j] = {{a.data[0][j], a.data[1][j], a.data[2][j]}};
    const auto d = corot::deformation_of(columns, corot::RestAxes<{scalar}>());
    const {scalar} m = {MU!r}f, k = {LAM!r}f;
    ({expression}).stress(d, m, k, p);
    return wp::mat_t<3, 3, {scalar}>(p[0].x, p[1].x, p[2].x, p[0].y, p[1].y, p[2].y, p[0].z, p[1].z, p[2].z);
#else
    return a;
#endif
"""

    @wp.func_native(snippet)
    def stress(a: matrix) -> matrix: ...

    @unique_kernel(native=headers("laws", "law_ogden"))
    def stresses(a: wp.array[matrix], p: wp.array[matrix]):
        i = wp.tid()
        p[i] = stress(a[i])

    return stresses, matrix


def ogden(F, terms):
    """P of Ogden's law within its limits, by eigenvectors."""
    squares, axes = np.linalg.eigh(np.swapaxes(F, 1, 2) @ F)
    slope = sum(2.0 * MU * w / alpha * squares ** (0.5 * alpha - 1.0) for w, alpha in terms)
    of_stretch = F @ (axes * slope[:, None, :]) @ np.swapaxes(axes, 1, 2)
    J, m = np.linalg.det(F)[:, None, None], MU * sum(2.0 * w / alpha for w, alpha in terms)
    return of_stretch + (LAM * np.log(J) - m) * np.swapaxes(np.linalg.inv(F), 1, 2)


#: A law of whole and other powers.
OGDEN = ((0.5, 8.0), (0.2, -4.0), (0.3, 3.3))


@pytest.mark.parametrize(("scalar", "dtype"), [("float", wp.float32), ("double", wp.float64)])
@pytest.mark.parametrize("law", ["corotated", "neo-hookean", OGDEN], ids=["corotated", "neo-hookean", "ogden"])
def test_a_law_is_the_same_in_every_scalar(law, scalar, dtype, rng):
    """Random strains, and with two or three equal principal stretches, turned by random rotations."""
    turns = [np.array([oracle.polar(rng.standard_normal((3, 3))) for _ in range(400)]) for _ in range(2)]
    stretches = rng.uniform(0.8, 1.25, (400, 3))
    stretches[:100, 1] = stretches[:100, 0]
    stretches[:50] = stretches[:50, :1]
    stretches[100:150, 1] = stretches[100:150, 2] * (1.0 + 10.0 ** rng.uniform(-7.0, -2.0, 50))
    F = turns[0] @ (turns[1] * stretches[:, None, :]) @ np.swapaxes(turns[1], 1, 2)
    kernel, matrix = stresses(scalar, dtype, law)
    a = wp.array(F - np.eye(3), dtype=matrix, device="cpu")
    p = wp.zeros_like(a)
    wp.launch(kernel, len(a), [a], [p], device="cpu")
    F = np.eye(3) + a.numpy().astype(float)
    if isinstance(law, str):
        expected = {"corotated": oracle.corotated, "neo-hookean": oracle.neo_hookean}[law](F, MU, LAM)[1]
    else:
        expected = ogden(F, law)
    # Ogden's eigenvalues have some digits less, of which the stress is the third power or so.
    tolerance = 2e-6 if scalar == "float" else 3e-7 if law is OGDEN else 1e-12
    np.testing.assert_allclose(p.numpy(), expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("law", sorted(LAWS))
def test_differentials_in_float64_are_those_of_differences(law, rng):
    """At random displacement gradients, some of them small, some turned over."""
    a, way = rng.normal(0.0, 0.3, (500, 3, 3)), rng.standard_normal((500, 3, 3))
    a[:100] *= 1e-3
    assert np.linalg.det(np.eye(3) + a).min() < 0.0
    found = float64.stresses(law, a, MU, LAM, way)
    assert found.valid.all()
    step = 1e-6
    ends = [float64.stresses(law, a + sign * step * way, MU, LAM).p for sign in (1.0, -1.0)]
    expected = (ends[0] - ends[1]) / (2.0 * step)
    np.testing.assert_allclose(found.dp, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_all_isotropic_laws_have_structs():
    text = (NATIVE / "laws.h").read_text()
    assert all(f"struct {name} {{" in text for name in LAWS.values())
