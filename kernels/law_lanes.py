"""Stresses of the constitutive laws for eight elements in the lanes of vector registers; see ``lanes``.

Each is a native function of the columns f of F, of E = C - I in the frame of these columns, of the frame's handedness
and of mu and lambda, which come times the weight that P shall have. It writes the columns p of P and says in which
lanes these may be trusted. E has its digits however small it is, and all is worked out from E: so P keeps them.

The corotated law needs no rotation for that. With t = tr S - 3, j = J - 1 and the invariants a, b, c of E, t is the
largest root of the quartic (Cayley-Hamilton for S; x = t + 3 is the largest eigenvalue of Horn's 4x4 matrix)
    t^4 + 12 t^3 + (48 - 2a) t^2 + (64 - 12a - 8j) t + a^2 - 20a - 24j - 4b = 0
whose slope is 4q, q = 2 (s1 + s2)(s1 + s3)(s2 + s3) of the principal stretches: no root is better defined. From it come
R = ((x^2 + tr C) F + 2 x cof F - 2 F C) / q, for every F of which q is not small, flattened and turned over
too; and where E is small, with its digits,
    I - S^-1 = (n0 I + (8 + y) E - (6 + y) adj E) / q,  y = (2t - 6j) / J,
    n0 = t (18 + t (8 + t)) - a (10 + t) - 2j - y (1 + a),  and  P = F (2 mu (I - S^-1) + lambda t S^-1).
"""

from .constitutive import CONTINUED_BELOW

#: q, 16 at rest, below which R is not trusted: the root has lost digits, or is about to meet another.
INDEFINITE = 1.0

#: What polynomials of the stretch S are made of; ``sound`` where q and the root are good.
STRETCH = f"""
    struct stretch {{ invariants of; lanes8 t, q; masks8 sound; }};
    const auto stretch_of = [&](const lanes8* e, const lanes8& det) {{
        stretch s;
        s.of = invariants_of(e, det);
        const lanes8 &a = s.of.a, &b = s.of.b, &c = s.of.c, &j = s.of.j;
        const lanes8 c0 = a * a - 20.0f * a - 24.0f * j - 4.0f * b, c1 = 64.0f - 12.0f * a - 8.0f * j;
        const lanes8 c2 = 48.0f - 2.0f * a;
        // The series of tr sqrt(I + E), or from above, where the iteration cannot miss the root.
        lanes8 t = 0.5f * a;
        const lanes8 &p2 = s.of.squared, p3 = a * p2 - b * a + 3.0f * c, p4 = a * p3 - b * p2 + c * a;
        const lanes8 p5 = a * p4 - b * p3 + c * p2;
        t = s.of.small ? t - 0.125f * p2 + 0.0625f * p3 - 0.0390625f * p4 + 0.02734375f * p5 : t;
        masks8 open = t == t;
        for (int iteration = 0; iteration < 24; ++iteration) {{
            const lanes8 value = (((t + 12.0f) * t + c2) * t + c1) * t + c0;
            const lanes8 slope = ((4.0f * t + 36.0f) * t + 2.0f * c2) * t + c1;
            const lanes8 step = value / slope;
            t = open ? t - step : t;
            open &= step * step > 1e-8f * (t + 3.0f) * (t + 3.0f);
            if (!any(open)) break;
        }}
        s.t = t;
        s.q = 16.0f + t * (24.0f + t * (9.0f + t)) - a * (3.0f + t) - 2.0f * j;
        s.sound = ~open & (s.q > {INDEFINITE!r}f) & (a < 1000.0f);
        return s;
    }};
"""

#: The columns r of the rotation of F, and where it may be trusted.
ROTATION = """
    const auto rotation_of = [&](const triple* f, const lanes8* e, const lanes8& handedness, triple* r) {
        const triple last = cross(f[0], f[1]);
        const stretch s = stretch_of(e, handedness * dot(f[2], last));
        const lanes8 w = 1.0f / s.q;
        lanes8 sigma[6];
        for (int i = 0; i < 6; ++i) sigma[i] = -2.0f * w * e[i];
        for (int i = 0; i < 3; ++i) sigma[i] += w * (10.0f + s.t * (6.0f + s.t) + s.of.a);
        times(f, sigma, r);
        const lanes8 v = 2.0f * (3.0f + s.t) * w * handedness;
        r[0] = added(r[0], v, cross(f[1], f[2]));
        r[1] = added(r[1], v, cross(f[2], f[0]));
        r[2] = added(r[2], v, last);
        return s.sound;
    };
"""

_COROTATED = f"""{STRETCH}
    const auto stress = [&](const triple* f, const lanes8* e, const lanes8& handedness, const lanes8& m,
            const lanes8& k, triple* p) {{
        const triple last = cross(f[0], f[1]);
        const stretch s = stretch_of(e, handedness * dot(f[2], last));
        const lanes8 &a = s.of.a, &j = s.of.j, &t = s.t;
        const lanes8 kt = k * t;
        const lanes8 w = (2.0f * m - kt) / s.q;
        const lanes8 y = (2.0f * t - 6.0f * j) / (1.0f + j);
        lanes8 s0 = kt + w * (t * (18.0f + t * (8.0f + t)) - a * (10.0f + t) - 2.0f * j - y * (1.0f + a));
        lanes8 s1 = w * (8.0f + y), s2 = -w * (6.0f + y);
        const bool mixed = any(~s.of.small);
        if (mixed) {{
            s0 = s.of.small ? s0 : 2.0f * m - w * (10.0f + t * (6.0f + t) + a);
            s1 = s.of.small ? s1 : 2.0f * w;
            s2 = s.of.small ? s2 : spread(0.0f);
        }}
        lanes8 sigma[6];
        for (int i = 0; i < 6; ++i) sigma[i] = s1 * e[i] + s2 * s.of.adjugate[i];
        for (int i = 0; i < 3; ++i) sigma[i] += s0;
        times(f, sigma, p);
        if (mixed) {{
            const lanes8 v = s.of.small ? spread(0.0f) : -2.0f * (3.0f + t) * w * handedness;
            p[0] = added(p[0], v, cross(f[1], f[2]));
            p[1] = added(p[1], v, cross(f[2], f[0]));
            p[2] = added(p[2], v, last);
            for (int i = 0; i < 3; ++i) p[i] = chosen(s.sound, p[i], nothing);
        }}
        return s.sound;
    }};
"""

#: Of the small strain in place of E and of the frame in place of F.
_LINEAR = """
    const auto stress = [&](const triple* frame, const lanes8* e, const lanes8&, const lanes8& m, const lanes8& k,
            triple* p) {
        lanes8 sigma[6];
        const lanes8 pressure = k * (e[0] + e[1] + e[2]);
        for (int i = 0; i < 6; ++i) sigma[i] = 2.0f * m * e[i];
        for (int i = 0; i < 3; ++i) sigma[i] += pressure;
        times(frame, sigma, p);
    };
"""

_STVK = """
    const auto stress = [&](const triple* f, const lanes8* e, const lanes8&, const lanes8& m, const lanes8& k,
            triple* p) {
        lanes8 sigma[6];
        const lanes8 pressure = 0.5f * k * (e[0] + e[1] + e[2]);
        for (int i = 0; i < 6; ++i) sigma[i] = m * e[i];
        for (int i = 0; i < 3; ++i) sigma[i] += pressure;
        times(f, sigma, p);
    };
"""

# P = cof F (mu E + lambda ln J I) / J, and below J0 mu F + U'(J) cof F with U' continued linearly.
_NEO_HOOKEAN = f"""
    // ln(1 + j) of positive 1 + j: twice the artanh of j / (2 + j), of what powers of two leave within sqrt(2).
    const auto log_of = [&](const lanes8& j) {{
        const lanes8 whole = 1.0f + j;
        const masks8 bits = reinterpret_cast<const masks8&>(whole);
        const masks8 power = (bits - 0x3f3504f3) >> 23;
        const masks8 reduced = bits - (power << 23);
        const lanes8 rest = power == 0 ? j : reinterpret_cast<const lanes8&>(reduced) - 1.0f;
        const lanes8 z = rest / (2.0f + rest), zz = z * z;
        const lanes8 series = 1.0f + zz * ({1 / 3!r}f + zz * (0.2f + zz * ({1 / 7!r}f + zz * {1 / 9!r}f)));
        return 0.6931472f * __builtin_convertvector(power, lanes8) + 2.0f * z * series;
    }};
    const auto stress = [&](const triple* f, const lanes8* e, const lanes8& handedness, const lanes8& m,
            const lanes8& k, triple* p) {{
        const triple cofactor[3] = {{cross(f[1], f[2]), cross(f[2], f[0]), cross(f[0], f[1])}};
        const lanes8 j = invariants_of(e, handedness * dot(f[0], cofactor[0])).j;
        const masks8 crushed = j < {CONTINUED_BELOW - 1.0!r}f;
        const lanes8 safe = crushed ? spread(0.0f) : j;
        const lanes8 w = handedness / (1.0f + safe);
        const lanes8 pressure = w * k * log_of(safe), mw = m * w;
        lanes8 sigma[6];
        for (int i = 0; i < 6; ++i) sigma[i] = mw * e[i];
        for (int i = 0; i < 3; ++i) sigma[i] += pressure;
        times(cofactor, sigma, p);
        if (any(crushed)) {{
            const float j0 = {CONTINUED_BELOW!r}f, log0 = -0.6931472f;
            const lanes8 slope = handedness * ((k * log0 - m) / j0
                + (m + k * (1.0f - log0)) / (j0 * j0) * (j + (1.0f - j0)));
            for (int i = 0; i < 3; ++i) {{
                p[i] = chosen(crushed, added(scaled(m, f[i]), slope, cofactor[i]), p[i]);
            }}
        }}
    }};
"""

#: Native code of ``stress`` by the law's name.
STRESSES = {"corotated": _COROTATED, "linear": _LINEAR, "stvk": _STVK, "neo-hookean": _NEO_HOOKEAN}
