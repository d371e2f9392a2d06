// The corotated law of orthotropic materials at a rotation that is found elsewhere; see corotated/anisotropic.py.
//
// In the material's axes P = R (s + [a]x), where s is the derivative of the energy density with respect to S, H a = axial(S s),
// and H = tr(S) I - S. For a differential R is dual, too: dR = R [w]x with H w = axial(R^T dF), where the determinant of H is
// bounded from below. The isotropic part of s adds nothing to axial(S s).
#pragma once

#include "laws.h"

namespace corot {

// det H / |S|^3 below which a law turns isotropic: 1.54 at rest, 0.4 flattened to 16 % in two directions, as fibres are that
// stretch 3.4 times, or inverted to -0.22 in one. With less, the transition is so steep that crushed bodies gain energy in
// explicit steps.
constexpr float BLENDED = 0.4f;
// det H / |S|^3 below which the rotation is taken to turn less than it does, and the largest entry of S below which it is. Both
// at zero, F has no definite rotation and the derivative does not exist.
constexpr float LEAST_DEFINITENESS = 1.0e-3f, LEAST_STRETCH = 1.0e-3f;

COROT_INLINE float value_of(float a) { return a; }
COROT_INLINE float value_of(const dual_of<float>& a) { return a.value; }
template <class S> COROT_INLINE S at_least(float least, const S& a) { return a < least ? spread<S>(least) : a; }

template <class A, class B> COROT_INLINE auto inner(const A* a, const B* b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + 2.0f * (a[3] * b[3] + a[4] * b[4] + a[5] * b[5]);
}

template <class A, class B> COROT_INLINE auto applied(const A* a, const triple<B>& v) {
    typedef decltype(a[0] * v.x) S;
    return triple<S>{a[0] * v.x + a[3] * v.y + a[4] * v.z, a[3] * v.x + a[1] * v.y + a[5] * v.z, a[4] * v.x + a[5] * v.y + a[2] * v.z};
}

// Adjugate of H, whose diagonal is h and whose other entries are those of -s, and its determinant.
template <class S> COROT_INLINE S turning_adjugate(const S* h, const S* s, S* adjugate) {
    adjugate[0] = h[1] * h[2] - s[5] * s[5];
    adjugate[1] = h[0] * h[2] - s[4] * s[4];
    adjugate[2] = h[0] * h[1] - s[3] * s[3];
    adjugate[3] = s[4] * s[5] + s[3] * h[2];
    adjugate[4] = s[3] * s[5] + s[4] * h[1];
    adjugate[5] = s[3] * s[4] + h[0] * s[5];
    return h[0] * adjugate[0] - s[3] * adjugate[3] - s[4] * adjugate[4];
}

// axial(e s) of symmetric tensors.
template <class S> COROT_INLINE triple<S> commutator(const S* e, const S* s) {
    const triple<S> rows[3] = {{e[0], e[3], e[4]}, {e[3], e[1], e[5]}, {e[4], e[5], e[2]}};
    const triple<S> columns[3] = {{s[0], s[3], s[4]}, {s[3], s[1], s[5]}, {s[4], s[5], s[2]}};
    return {dot(rows[2], columns[1]) - dot(rows[1], columns[2]), dot(rows[0], columns[2]) - dot(rows[2], columns[0]),
        dot(rows[1], columns[0]) - dot(rows[0], columns[1])};
}

// Columns of R (s + [a]x).
template <class S> COROT_INLINE void turned_columns(const S* s, const triple<S>& a, const triple<S>* r, triple<S>* p) {
    p[0] = combined(s[0], r[0], s[3] + a.z, r[1], s[4] - a.y, r[2]);
    p[1] = combined(s[3] - a.z, r[0], s[1], r[1], s[5] + a.x, r[2]);
    p[2] = combined(s[4] + a.y, r[0], s[5] - a.x, r[1], s[2], r[2]);
}

// The stress of a strain, both in the material's axes, by a stiffness C_11, C_22, C_33, C_12, C_13, C_23, G_12, G_13, G_23.
template <class N, class S> COROT_INLINE void orthotropic_stress(const N* c, const S* e, S* s) {
    s[0] = c[0] * e[0] + c[3] * e[1] + c[4] * e[2];
    s[1] = c[3] * e[0] + c[1] * e[1] + c[5] * e[2];
    s[2] = c[4] * e[0] + c[5] * e[1] + c[2] * e[2];
    for (int i = 3; i < 6; ++i) s[i] = 2.0f * c[3 + i] * e[i];
}

// S = I + e scaled to order one, so that no power of it is out of range; |S|^2; and adjugate and determinant of H.
template <class S> struct Turning {
    float scale;
    S stretch[6], squared, adjugate[6], det;
};

template <class S> COROT_INLINE Turning<S> turning_of(const S* e, float least) {
    Turning<S> t;
    float largest = least;
    for (int i = 0; i < 6; ++i) {
        const float entry = value_of(e[i]) + (i < 3 ? 1.0f : 0.0f), size = entry < 0.0f ? -entry : entry;
        largest = size > largest ? size : largest;
    }
    t.scale = over(1.0f, largest);
    for (int i = 0; i < 6; ++i) t.stretch[i] = (i < 3 ? e[i] + 1.0f : e[i]) * t.scale;
    const S* s = t.stretch;
    const S h[3] = {s[1] + s[2], s[0] + s[2], s[0] + s[1]};
    t.squared = inner(s, s);
    t.det = turning_adjugate(h, s, t.adjugate);
    return t;
}

// The matrix by which axial(R^T dF) is the turning w of R.
COROT_INLINE void turning_matrix(const float* e, float* w) {
    const Turning<float> t = turning_of(e, LEAST_STRETCH);
    const float least = at_least(1.0e-12f, LEAST_DEFINITENESS * t.squared * root(t.squared));
    const float factor = over(t.scale, at_least(least, t.det));
    for (int i = 0; i < 6; ++i) w[i] = factor * t.adjugate[i];
}

// e = S - I of a deformation in the material's axes and columns r of R times these, to all its digits: S^2 = F^T F, so e = E -
// e^2 / 2 with Green's strain E, and where e is small, the error of a rough one hardly changes this.
template <class D, class S> COROT_INLINE void stretch_strain(const D& d, const triple<S>* r, S* e) {
    const auto* q = d.frame.q;
    const triple<S> turned[3] = {r[0] - q[0], r[1] - q[1], r[2] - q[2]};
    const int first[6] = {0, 1, 2, 0, 0, 1}, second[6] = {0, 1, 2, 1, 2, 2};
    for (int i = 0; i < 6; ++i) {
        const int j = first[i], k = second[i];
        e[i] = 0.5f * (dot(r[j], d.a[k]) + dot(r[k], d.a[j]) - dot(turned[j], turned[k]));
    }
    if (inner(e, e) < 0.25f) {
        const triple<S> rows[3] = {{e[0], e[3], e[4]}, {e[3], e[1], e[5]}, {e[4], e[5], e[2]}};
        for (int i = 0; i < 6; ++i) e[i] = 0.5f * (d.e[i] - dot(rows[first[i]], rows[second[i]]));
    }
}

// The stiffness c of an orthotropic material, and the nearest isotropic one.
struct Orthotropic {
    const float* c;
    const float mu, lam;

    // s less that of the isotropic material.
    template <class S> COROT_INLINE void excess(const S* e, const S* s, S* more) const {
        const S pressure = lam * (e[0] + e[1] + e[2]);
        for (int i = 0; i < 6; ++i) more[i] = s[i] - 2.0f * mu * e[i] - (i < 3 ? pressure : spread<S>(0.0f));
    }

    // The share b of the law that is not isotropic, of det H / |S|^3 over ``BLENDED``.
    template <class S> static COROT_INLINE S share(const S& y) { return y * y * (3.0f - 2.0f * y); }
    template <class S> static COROT_INLINE S bounded(const S& y) { return y < 0.0f ? spread<S>(0.0f) : y > 1.0f ? spread<S>(1.0f) : y; }

    // s and a.
    template <class S> COROT_INLINE void stress(const S* e, S* s, triple<S>& a) const {
        orthotropic_stress(c, e, s);
        // Changes of a stretch may be far larger than it.
        const Turning<S> t = turning_of(e, same<S, float>::value ? 1.0e-30f : LEAST_STRETCH);
        const S squared = at_least(1.0e-12f, t.squared), cubed = squared * root(squared), x = over(t.det, cubed);
        S turning[6];
        for (int i = 0; i < 6; ++i) turning[i] = s[i];
        if (x < BLENDED) {
            const S y = bounded(x * (1.0f / BLENDED)), b = share(y), trace = t.adjugate[0] + t.adjugate[1] + t.adjugate[2];
            S more[6];
            excess(e, s, more);
            const S slope = (3.0f * t.scale / BLENDED) * y * (1.0f - y) * inner(e, more);
            for (int i = 0; i < 6; ++i) {
                turning[i] = b * more[i];
                const S of_det = (i < 3 ? trace : spread<S>(0.0f)) - t.adjugate[i];
                s[i] = s[i] - more[i] + turning[i] + slope * (over(of_det, cubed) - over(3.0f * x, squared) * t.stretch[i]);
            }
        }
        a = applied(t.adjugate, commutator(e, turning) * t.scale) * over(spread<S>(1.0f), at_least(1.0e-20f, t.det));
    }

    COROT_INLINE float energy(const float* e) const {
        const Turning<float> t = turning_of(e, 1.0e-30f);
        const float squared = at_least(1.0e-12f, t.squared), x = over(t.det, squared * root(squared));
        float s[6], more[6];
        orthotropic_stress(c, e, s);
        excess(e, s, more);
        return 0.5f * (inner(e, s) - (x < BLENDED ? 1.0f - share(bounded(x * (1.0f / BLENDED))) : 0.0f) * inner(e, more));
    }

    // The columns of P times the axes.
    template <class D, class S> COROT_INLINE void stress(const D& d, const triple<S>* r, triple<S>* p) const {
        S e[6], s[6];
        triple<S> a;
        stretch_strain(d, r, e);
        stress(e, s, a);
        turned_columns(s, a, r, p);
    }
};

// The columns of R as dual numbers, of changes of F's columns.
template <class D, class T> COROT_INLINE void turn_of(const D& d, const float* e, const triple<T>* r, triple<dual_of<T>>* to) {
    T w[6];
    turning_matrix(e, w);
    triple<T> change[3];
    for (int j = 0; j < 3; ++j) change[j] = {d.a[j].x.slope, d.a[j].y.slope, d.a[j].z.slope};
    const triple<T> v = applied(w, triple<T>{dot(r[2], change[1]) - dot(r[1], change[2]), dot(r[0], change[2]) - dot(r[2], change[0]),
        dot(r[1], change[0]) - dot(r[0], change[1])});
    const triple<T> turned[3] = {r[1] * v.z - r[2] * v.y, r[2] * v.x - r[0] * v.z, r[0] * v.y - r[1] * v.x};
    for (int j = 0; j < 3; ++j) to[j] = {{r[j].x, turned[j].x}, {r[j].y, turned[j].y}, {r[j].z, turned[j].z}};
}

}  // namespace corot
