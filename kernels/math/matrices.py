"""Small matrices for rotations and constitutive laws."""

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_FLOAT = wp.constant(3.4028234e38)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
#else
    return 1.0f / x;
#endif
""")
def reciprocal(x: float) -> float:
    """1 / x, accurate to the last digit but one, in one instruction."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float r;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
#else
    return sqrtf(x);
#endif
""")
def square_root(x: float) -> float:
    """The root of x >= 0, accurate to the last digit but one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float r;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
#else
    return 1.0f / sqrtf(x);
#endif
""")
def reciprocal_root(x: float) -> float:
    """1 / sqrt(x), accurate to the last digit but one."""
    ...


@wp.func
def identity3():
    return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def column(a: wp.mat33, j: int):
    return wp.vec3(a[0, j], a[1, j], a[2, j])


@wp.func
def cofactor(a: wp.mat33):
    """det(A) A^-T, which exists for every A."""
    a0 = column(a, 0)
    a1 = column(a, 1)
    a2 = column(a, 2)
    return wp.matrix_from_cols(wp.cross(a1, a2), wp.cross(a2, a0), wp.cross(a0, a1))


@wp.func
def axial(a: wp.mat33):
    """The vector w with [w]x = A - A^T."""
    return wp.vec3(a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1])


@wp.func
def frobenius(a: wp.mat33):
    return wp.sqrt(wp.ddot(a, a))


@wp.func
def largest_entry(a: wp.mat33):
    m = float(0.0)
    for i in range(3):
        for j in range(3):
            m = wp.max(m, wp.abs(a[i, j]))
    return m


@wp.func
def all_finite(a: wp.mat33):
    ok = bool(True)
    for i in range(3):
        for j in range(3):
            # A comparison with NaN is false, and so is one with an infinity beyond the largest float.
            ok = ok and (wp.abs(a[i, j]) <= MAX_FLOAT)
    return ok


@wp.func
def semidefinite(a: wp.mat33):
    """A symmetric block without its negative eigenvalues."""
    q, values = wp.eig3(0.5 * (a + wp.transpose(a)))
    kept = wp.vec3(wp.max(values[0], 0.0), wp.max(values[1], 0.0), wp.max(values[2], 0.0))
    return q * wp.diag(kept) * wp.transpose(q)
