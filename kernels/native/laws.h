// Isotropic laws as functions of a ``Deformation``: ``stress`` writes the columns p of the first Piola-Kirchhoff stress
// times the frame and returns where they may be trusted; ``energy`` is the energy density of a single element. mu and lambda
// are already multiplied by the weight of P. All is computed from E, which keeps its digits however small it is, so P and the
// density keep them, too. No law subtracts numbers near one.
#pragma once

#include "deformation.h"

namespace corot {

// mu e : e + lambda / 2 (tr e)^2.
template <class S, class N> COROT_INLINE S hooke_energy(const S* e, const N& m, const N& k) {
    const S trace = e[0] + e[1] + e[2];
    return m * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2] + 2.0f * (e[3] * e[3] + e[4] * e[4] + e[5] * e[5]))
        + 0.5f * k * trace * trace;
}

// P = sigma(e) of the small strain e.
struct Linear {
    template <class D, class S = typename D::S> static COROT_INLINE S energy(const D& d, const S& m, const S& k) {
        S e[6];
        small_strain(d.a, d.frame, e);
        return hooke_energy(e, m, k);
    }
    template <class D, class N, class S = typename D::S>
    static COROT_INLINE mask_of<S> stress(const D& d, const N& m, const N& k, triple<S>* p) {
        S e[6], sigma[6];
        small_strain(d.a, d.frame, e);
        const S pressure = k * (e[0] + e[1] + e[2]);
        for (int i = 0; i < 6; ++i) sigma[i] = 2.0f * m * e[i];
        for (int i = 0; i < 3; ++i) sigma[i] += pressure;
        frame_times(d.frame, sigma, p);
        return every<S>();
    }
};

// P = F (mu E + lambda / 2 tr E).
struct StVenantKirchhoff {
    template <class D, class S = typename D::S> static COROT_INLINE S energy(const D& d, const S& m, const S& k) {
        return hooke_energy(d.e, 0.25f * m, 0.25f * k);
    }
    template <class D, class N, class S = typename D::S>
    static COROT_INLINE mask_of<S> stress(const D& d, const N& m, const N& k, triple<S>* p) {
        S sigma[6];
        const S pressure = 0.5f * k * (d.e[0] + d.e[1] + d.e[2]);
        for (int i = 0; i < 6; ++i) sigma[i] = m * d.e[i];
        for (int i = 0; i < 3; ++i) sigma[i] += pressure;
        times(d.f, sigma, p);
        return every<S>();
    }
};

// With t, j and q of ``Stretch``, I - S^-1 = (n0 I + (8 + y) E - (6 + y) adj E) / q, y = (2t - 6j) / J, n0 = t (18 + t (8 +
// t)) - a (10 + t) - 2j - y (1 + a), and P = F (2 mu (I - S^-1) + lambda t S^-1), where E is small; elsewhere by R. P is
// zero where it is not trusted.
struct Corotated {
    // mu |D|^2 + lambda / 2 t^2 with D = S - I, of invariants t, i2, i3: |D|^2 = t^2 - 2 i2. From 2 i2 = t^2 + 2t - tr E come few
    // digits where the strain is small. There E = D^2 + 2D gives tr adj E = i2 (4 + 2t + i2) - i3 (6 + 2t) and det E = i3 (8 +
    // 4t + 2 i2 + i3), in which the sums need no more digits than that i2 has.
    template <class D> static COROT_INLINE float energy(const D& d, float m, float k) {
        const triple<float>* f = d.f;
        const Stretch<float> s = stretch_of(d.e, handedness_of(d.frame) * dot(f[0], cross(f[1], f[2])));
        const float t = s.t;
        float i2 = 0.5f * (t * (2.0f + t) - s.of.a);
        if (s.of.squared < 0.4f) {
            const float i3 = over(s.of.c, 8.0f + 4.0f * t + 2.0f * i2 + (s.of.j - t - i2));
            i2 = over(s.of.b + i3 * (6.0f + 2.0f * t), 4.0f + 2.0f * t + i2);
        }
        return m * (t * t - 2.0f * i2) + 0.5f * k * t * t;
    }
    template <class D, class N, class S = typename D::S>
    static COROT_INLINE mask_of<S> stress(const D& d, const N& m, const N& k, triple<S>* p) {
        const triple<S>* f = d.f;
        const triple<S> last = cross(f[0], f[1]);
        const auto handedness = handedness_of(d.frame);
        const Stretch<S> s = stretch_of(d.e, handedness * dot(f[2], last));
        if constexpr (same<S, float>::value) {
            if (!s.valid) return false;
        }
        const S &a = s.of.a, &j = s.of.j, &t = s.t;
        const S kt = k * t;
        const S w = over(2.0f * m - kt, s.q);
        const S y = over(2.0f * t - 6.0f * j, s.volume);
        S s0 = kt + w * (t * (18.0f + t * (8.0f + t)) - a * (10.0f + t) - 2.0f * j - y * (1.0f + a));
        S s1 = w * (8.0f + y), s2 = -w * (6.0f + y);
        const bool mixed = any(inverted(s.of.small));
        if (mixed) {
            s0 = s.of.small ? s0 : 2.0f * m - w * (10.0f + t * (6.0f + t) + a);
            s1 = s.of.small ? s1 : 2.0f * w;
            s2 = s.of.small ? s2 : spread<S>(0.0f);
        }
        S sigma[6];
        for (int i = 0; i < 6; ++i) sigma[i] = (i < 3 ? s0 + s1 * d.e[i] : s1 * d.e[i]) + s2 * s.of.adjugate[i];
        times(f, sigma, p);
        if (mixed) {
            const S v = s.of.small ? spread<S>(0.0f) : -2.0f * (3.0f + t) * w * handedness;
            p[0] = added(p[0], v, cross(f[1], f[2]));
            p[1] = added(p[1], v, cross(f[2], f[0]));
            p[2] = added(p[2], v, last);
            for (int i = 0; i < 3; ++i) p[i] = chosen(s.valid, p[i], nothing<S>());
        }
        return s.valid;
    }
};

// J below which the volumetric energy is its own Taylor polynomial of second order about this J, and its logarithm.
constexpr float CONTINUED_BELOW = 0.5f;
constexpr double LOG_CONTINUED = -0.6931471805599453;

// V'(J) of V = U + mu (J - 1), which is zero at rest, with U = -mu ln J + lambda / 2 (ln J)^2: a straight line below J0.
template <class S, class N> COROT_INLINE S volumetric_slope(const S& j, const N& m, const N& k) {
    const float j0 = CONTINUED_BELOW;
    const N log0 = spread<N>(LOG_CONTINUED);
    const mask_of<S> crushed = j < j0 - 1.0f;
    const S safe = crushed ? spread<S>(0.0f) : j;
    const S line = (k * log0 + m * (j0 - 1.0f)) / j0 + (m + k * (1.0f - log0)) / (j0 * j0) * (j + (1.0f - j0));
    return crushed ? line : over(k * log_of(safe) + m * safe, 1.0f + safe);
}

// P = cof F (mu E + lambda ln J) / J; below J0 = CONTINUED_BELOW mu F + U'(J) cof F, with U' continued linearly. In the axes of
// rest space P = mu (F - cof F) + V' cof F, F - cof F = A + A^T - tr A I - cof A, where nothing of order one cancels.
struct NeoHookean {
    // mu / 2 tr E - mu ln J + lambda / 2 (ln J)^2; where E is small, the first two from J^2 - 1 = a + b + c.
    template <class D, class S = typename D::S> static COROT_INLINE S energy(const D& d, const S& m, const S& k) {
        const triple<S>* f = d.f;
        const Invariants<S> i = invariants_of(d.e, handedness_of(d.frame) * dot(f[0], cross(f[1], f[2])));
        const S low = CONTINUED_BELOW - 1.0f, inside = i.j < low ? low : i.j, step = i.j - inside;
        const S square = i.a + i.b + i.c;
        S excess, unused;
        const S log = log_of(inside, unused);
        const bool near = i.small && square > -0.5f && square < 0.5f;
        log_of(near ? square : inside, excess);
        const S shear = near ? 0.5f * (excess - i.b - i.c) : 0.5f * i.a - log;
        const S slope = over(k * log - m, 1.0f + inside), curvature = over(m + k * (1.0f - log), (1.0f + inside) * (1.0f + inside));
        return m * shear + 0.5f * k * log * log + step * (slope + 0.5f * curvature * step);
    }
    template <class S, class N>
    static COROT_INLINE mask_of<S> stress(const Deformation<S, RestAxes<N>>& d, const N& m, const N& k, triple<S>* p) {
        const triple<S>* a = d.a;
        triple<S> c[3];
        cofactors(a, c);
        const S slope = volumetric_slope(volume_change(a, c), m, k), rest = m - slope;
        const S diagonal = slope - rest * (a[0].x + a[1].y + a[2].z);
        p[0] = added(a[0] * m, rest, triple<S>{a[0].x, a[1].x, a[2].x} - c[0]);
        p[1] = added(a[1] * m, rest, triple<S>{a[0].y, a[1].y, a[2].y} - c[1]);
        p[2] = added(a[2] * m, rest, triple<S>{a[0].z, a[1].z, a[2].z} - c[2]);
        p[0].x += diagonal, p[1].y += diagonal, p[2].z += diagonal;
        return every<S>();
    }
    template <class S, class N>
    static COROT_INLINE mask_of<S> stress(const Deformation<S, Frame<N>>& d, const N& m, const N& k, triple<S>* p) {
        const triple<S>* f = d.f;
        const auto handedness = d.frame.handedness;
        const triple<S> cofactor[3] = {cross(f[1], f[2]), cross(f[2], f[0]), cross(f[0], f[1])};
        const S j = volume_change(d.a, d.frame);
        const mask_of<S> crushed = j < CONTINUED_BELOW - 1.0f;
        const S safe = crushed ? spread<S>(0.0f) : j;
        const S w = over(handedness, 1.0f + safe);
        const S pressure = w * k * log_of(safe), mw = m * w;
        S sigma[6];
        for (int i = 0; i < 6; ++i) sigma[i] = mw * d.e[i];
        for (int i = 0; i < 3; ++i) sigma[i] += pressure;
        times(cofactor, sigma, p);
        if (any(crushed)) {
            const S slope = handedness * (volumetric_slope(j, m, k) - m);
            for (int i = 0; i < 3; ++i) p[i] = chosen(crushed, added(f[i] * m, slope, cofactor[i]), p[i]);
        }
        return every<S>();
    }
};

// --- laws with their material, as traversals take them ---------------------------------------------------------------
//
// ``begin`` is called once with the nodes that a traversal has gathered; then ``stress`` for each element, with the place
// ``at``: see elements8.h and subtrees8.h. The stress is nothing in lanes that are ``done``.

// A single element, whose stresses have no weight.
struct Single {
    typedef float N;
    const int t;
    COROT_INLINE float weight() const { return 1.0f; }
    COROT_INLINE float values_of(const float* values) const { return values[t]; }
    template <class Values> COROT_INLINE float value(const Values& values, int stride) const { return values.data[t * stride]; }
    COROT_INLINE void write(const float* values, float a) const { const_cast<float*>(values)[t] = a; }
    COROT_INLINE bool done() const { return false; }
};

// ``COUNT`` numbers of each element, from arrays of one entry (stride 0) or one for each element.
template <int COUNT, class Entry> COROT_INLINE void gather_numbers(const Single& at, const Entry& entry, int stride, float* to) {
    for (int i = 0; i < COUNT; ++i) to[i] = entry(at.t * stride)[i];
}

#if !defined(__CUDACC__)
template <int COUNT, class Entry, class At> COROT_INLINE void gather_numbers(const At& at, const Entry& entry, int stride, lanes8* to) {
    if (!stride) {
        for (int i = 0; i < COUNT; ++i) to[i] = spread<lanes8>(entry(0)[i]);
        return;
    }
    for (int i = 0; i + 4 <= COUNT; i += 4) gather([&](int lane) { return entry(at.element(lane)) + i; }, to + i);
    if (COUNT % 4) to[COUNT - 1] = gather_one([&](int lane) { return entry(at.element(lane)) + COUNT - 1; });
}
#endif

// A law with Lame's parameters of a Warp struct that has mu, lam and stride.
template <class Law, class Material> struct Elastic {
    const Law law;
    const Material& material;
    template <class Nodes> COROT_INLINE void begin(const Nodes&) {}
    template <class D, class At, class S = typename D::S>
    COROT_INLINE mask_of<S> stress(const D& d, const At& at, triple<S>* p) const {
        const typename At::N weight = at.weight(), m = weight * at.value(material.mu, material.stride);
        const mask_of<S> valid = law.stress(d, m, weight * at.value(material.lam, material.stride), p);
        for (int j = 0; j < 3; ++j) p[j] = chosen(at.done(), nothing<S>(), p[j]);
        return valid;
    }
    template <class D> COROT_INLINE float energy(const D& d, const Single& at) const {
        return law.energy(d, at.value(material.mu, material.stride), at.value(material.lam, material.stride));
    }
};

template <class Law, class Material> COROT_INLINE Elastic<Law, Material> elastic(const Law& law, const Material& material) {
    return {law, material};
}

// No law.
struct Stressless {
    template <class Nodes> COROT_INLINE void begin(const Nodes&) {}
    template <class D, class At, class S = typename D::S>
    COROT_INLINE mask_of<S> stress(const D&, const At&, triple<S>* p) const {
        for (int j = 0; j < 3; ++j) p[j] = nothing<S>();
        return every<S>();
    }
};

// Two laws side by side.
template <class First, class Second> struct Sum {
    First first;
    Second second;
    template <class Nodes> COROT_INLINE void begin(const Nodes& nodes) {
        first.begin(nodes);
        second.begin(nodes);
    }
    template <class D, class At, class S = typename D::S>
    COROT_INLINE mask_of<S> stress(const D& d, const At& at, triple<S>* p) const {
        triple<S> more[3];
        mask_of<S> valid = first.stress(d, at, p);
        valid &= second.stress(d, at, more);
        for (int j = 0; j < 3; ++j) p[j] = p[j] + more[j];
        return valid;
    }
};

template <class First, class Second> COROT_INLINE Sum<First, Second> sum(const First& first, const Second& second) {
    return {first, second};
}

}  // namespace corot
