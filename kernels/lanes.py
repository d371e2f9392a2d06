"""Eight of a thing side by side in the lanes of a CPU's vector registers: native code that the fast CPU kernels share.

What a CPU core lacks is vectorisation. The lanes here are the compiler's own vector type: code on them compiles in
about a second, depends on no optimiser to find the vectors, and so is right and fast whatever its flags. The same in
Warp's 8-lane vectors took ten times as long to compile and was as fast only where the optimiser saw through it.
"""

from .rotation import FLAT, ITERATIONS, UNCONVERGED

#: The vectors are as wide as the machine at hand has them.
COMPILER_FLAGS = "-march=native"

LANES = 8

#: Vectors and triples of them. Nodes are read and written three components at 3 * node.
PRELUDE = """
    typedef float lanes8 __attribute__((vector_size(32), aligned(4)));
    typedef int masks8 __attribute__((vector_size(32)));
    struct triple { lanes8 x, y, z; };
    const auto plus = [](const triple& a, const triple& b) { return triple{a.x + b.x, a.y + b.y, a.z + b.z}; };
    const auto minus = [](const triple& a, const triple& b) { return triple{a.x - b.x, a.y - b.y, a.z - b.z}; };
    const auto scaled = [](const lanes8& w, const triple& a) { return triple{w * a.x, w * a.y, w * a.z}; };
    const auto dot = [](const triple& a, const triple& b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
    const auto cross = [](const triple& a, const triple& b) {
        return triple{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    };
    const auto spread = [](float a) { return lanes8{a, a, a, a, a, a, a, a}; };
    const auto get = [](const lanes8* a, int node) { return triple{a[3 * node], a[3 * node + 1], a[3 * node + 2]}; };
    const auto add = [](lanes8* a, int node, const triple& b) {
        a[3 * node] += b.x; a[3 * node + 1] += b.y; a[3 * node + 2] += b.z;
    };
"""

#: Z = 2^ITERATIONS R of the columns of F, and a mask of the lanes that may be trusted: false where NaN comes in.
NEWTON = f"""
    const auto newton = [&](triple a, triple b, triple c, const lanes8& handedness, triple* z) {{
        lanes8 det = spread(0.0f);
        masks8 sound = det > 0.0f;
        float s2 = 1.0f;
        for (int iteration = 0; iteration < {ITERATIONS}; ++iteration) {{
            const triple p = cross(b, c), q = cross(c, a), r = cross(a, b);
            det = dot(a, p);
            if (iteration == 0) sound = handedness * det > {float(FLAT)!r}f;
            const lanes8 w = s2 / det;
            a = plus(a, scaled(w, p)); b = plus(b, scaled(w, q)); c = plus(c, scaled(w, r));
            s2 *= 4.0f;
        }}
        z[0] = a; z[1] = b; z[2] = c;
        return sound & (handedness * det < {8.0 ** (ITERATIONS - 1) * (1.0 + float(UNCONVERGED))!r}f);
    }};
"""


def on_cpu(code: str) -> str:
    """A native snippet that is nothing where Warp compiles it for a GPU."""
    return f"#if !defined(__CUDA_ARCH__)\n{code}\n#endif\n"
