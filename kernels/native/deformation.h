// What laws read: the deformation of an element in an orthonormal frame of its own, strains without cancellation, and the
// stretch and the rotation of the polar decomposition.
#pragma once

#include "simd8.h"

namespace corot {

// An orthonormal frame in rest space by its columns; ``handedness`` is its determinant.
template <class S> struct Frame {
    triple<S> q[3];
    S handedness;
};

// The axes of rest space.
template <class S> struct RestAxes {};

template <class S> COROT_INLINE S handedness_of(const Frame<S>& frame) { return frame.handedness; }
template <class S> COROT_INLINE float handedness_of(const RestAxes<S>&) { return 1.0f; }

// The displacement gradient G times the frame, by columns a; the columns f of F times the frame; and E = F^T F - I in the
// frame (00, 11, 22, 01, 02, 12), without cancellation.
template <class S_, class Axes> struct Deformation {
    typedef S_ S;
    triple<S> a[3], f[3];
    S e[6];
    Axes frame;
};

template <class S, class N> COROT_INLINE Deformation<S, Frame<N>> deformation_of(const triple<S>* a, const Frame<N>& frame) {
    Deformation<S, Frame<N>> d;
    triple<S> h[3];
    d.frame = frame;
    for (int j = 0; j < 3; ++j) d.a[j] = a[j];
    for (int j = 0; j < 3; ++j) h[j] = added(frame.q[j], 0.5f, a[j]);
    for (int j = 0; j < 3; ++j) d.e[j] = 2.0f * dot(a[j], h[j]);
    d.e[3] = dot(a[0], h[1]) + dot(a[1], h[0]);
    d.e[4] = dot(a[0], h[2]) + dot(a[2], h[0]);
    d.e[5] = dot(a[1], h[2]) + dot(a[2], h[1]);
    for (int j = 0; j < 3; ++j) d.f[j] = frame.q[j] + a[j];
    return d;
}

template <class S, class N> COROT_INLINE Deformation<S, RestAxes<N>> deformation_of(const triple<S>* a, const RestAxes<N>&) {
    Deformation<S, RestAxes<N>> d;
    for (int j = 0; j < 3; ++j) d.a[j] = d.f[j] = a[j];
    d.e[0] = 2.0f * a[0].x + dot(a[0], a[0]);
    d.e[1] = 2.0f * a[1].y + dot(a[1], a[1]);
    d.e[2] = 2.0f * a[2].z + dot(a[2], a[2]);
    d.e[3] = a[0].y + a[1].x + dot(a[0], a[1]);
    d.e[4] = a[0].z + a[2].x + dot(a[0], a[2]);
    d.e[5] = a[1].z + a[2].y + dot(a[1], a[2]);
    d.f[0].x += 1.0f; d.f[1].y += 1.0f; d.f[2].z += 1.0f;
    return d;
}

// theta = J - 1 with the digits of small strains, and cofactors of A in the axes of rest space.
template <class S, class N> COROT_INLINE S volume_change(const triple<S>* a, const Frame<N>& frame) {
    const triple<N>* q = frame.q;
    const triple<S> crossed = cross(a[0], q[1]) + cross(q[0], a[1]);
    return dot(a[0], q[0]) + dot(a[1], q[1]) + dot(a[2], q[2])
        + frame.handedness * (dot(a[2], crossed) + dot(cross(a[0], a[1]), q[2] + a[2]));
}

template <class S> COROT_INLINE S volume_change(const triple<S>* a, const triple<S>* cofactor) {
    return a[0].x + a[1].y + a[2].z + (cofactor[0].x + cofactor[1].y + cofactor[2].z + dot(a[0], cofactor[0]));
}

template <class S> COROT_INLINE void cofactors(const triple<S>* a, triple<S>* c) {
    c[0] = cross(a[1], a[2]), c[1] = cross(a[2], a[0]), c[2] = cross(a[0], a[1]);
}

template <class S, class N> COROT_INLINE S volume_change(const triple<S>* a, const RestAxes<N>&) {
    triple<S> c[3];
    cofactors(a, c);
    return volume_change(a, c);
}

// The small strain in the frame.
template <class S, class N> COROT_INLINE void small_strain(const triple<S>* a, const Frame<N>& frame, S* e) {
    const triple<N>* q = frame.q;
    for (int j = 0; j < 3; ++j) e[j] = dot(q[j], a[j]);
    e[3] = 0.5f * (dot(q[0], a[1]) + dot(q[1], a[0]));
    e[4] = 0.5f * (dot(q[0], a[2]) + dot(q[2], a[0]));
    e[5] = 0.5f * (dot(q[1], a[2]) + dot(q[2], a[1]));
}

template <class S, class N> COROT_INLINE void small_strain(const triple<S>* a, const RestAxes<N>&, S* e) {
    e[0] = a[0].x, e[1] = a[1].y, e[2] = a[2].z;
    e[3] = 0.5f * (a[0].y + a[1].x), e[4] = 0.5f * (a[0].z + a[2].x), e[5] = 0.5f * (a[1].z + a[2].y);
}

// Symmetric tensors from the frame to the axes of rest space and back; vectors from these into the frame; and the columns
// of the frame times a symmetric tensor.
template <class N, class S> COROT_INLINE void out_of_frame(const Frame<N>& frame, const S* s, S* to) {
    const triple<N>* q = frame.q;
    triple<S> v[3];
    times(q, s, v);
    to[0] = v[0].x * q[0].x + v[1].x * q[1].x + v[2].x * q[2].x;
    to[1] = v[0].y * q[0].y + v[1].y * q[1].y + v[2].y * q[2].y;
    to[2] = v[0].z * q[0].z + v[1].z * q[1].z + v[2].z * q[2].z;
    to[3] = v[0].x * q[0].y + v[1].x * q[1].y + v[2].x * q[2].y;
    to[4] = v[0].x * q[0].z + v[1].x * q[1].z + v[2].x * q[2].z;
    to[5] = v[0].y * q[0].z + v[1].y * q[1].z + v[2].y * q[2].z;
}

template <class N, class S> COROT_INLINE void into_frame(const Frame<N>& frame, const S* s, S* to) {
    const triple<N>* q = frame.q;
    const triple<S> rows[3] = {{s[0], s[3], s[4]}, {s[3], s[1], s[5]}, {s[4], s[5], s[2]}};
    triple<S> v[3];
    for (int j = 0; j < 3; ++j) v[j] = {dot(rows[0], q[j]), dot(rows[1], q[j]), dot(rows[2], q[j])};
    for (int j = 0; j < 3; ++j) to[j] = dot(q[j], v[j]);
    to[3] = dot(q[0], v[1]);
    to[4] = dot(q[0], v[2]);
    to[5] = dot(q[1], v[2]);
}

template <class N> COROT_INLINE triple<N> into_frame(const Frame<N>& frame, const triple<N>& a) {
    return {dot(frame.q[0], a), dot(frame.q[1], a), dot(frame.q[2], a)};
}

template <class N, class S> COROT_INLINE void frame_times(const Frame<N>& frame, const S* s, triple<S>* p) { times(frame.q, s, p); }

template <class N, class S> COROT_INLINE void out_of_frame(const RestAxes<N>&, const S* s, S* to) {
    for (int i = 0; i < 6; ++i) to[i] = s[i];
}

template <class N, class S> COROT_INLINE void into_frame(const RestAxes<N>&, const S* s, S* to) {
    for (int i = 0; i < 6; ++i) to[i] = s[i];
}

template <class N> COROT_INLINE triple<N> into_frame(const RestAxes<N>&, const triple<N>& a) { return a; }

template <class N, class S> COROT_INLINE void frame_times(const RestAxes<N>&, const S* s, triple<S>* p) {
    p[0] = {s[0], s[3], s[4]};
    p[1] = {s[3], s[1], s[5]};
    p[2] = {s[4], s[5], s[2]};
}

// Adjugate and invariants of E, and J - 1 from these where E is small: |E|^2 < 0.4.
template <class S> struct Invariants {
    S adjugate[6], a, b, c, squared, j;
    mask_of<S> small;
};

template <class S> COROT_INLINE Invariants<S> invariants_of(const S* e) {
    Invariants<S> i;
    i.adjugate[0] = e[1] * e[2] - e[5] * e[5];
    i.adjugate[1] = e[0] * e[2] - e[4] * e[4];
    i.adjugate[2] = e[0] * e[1] - e[3] * e[3];
    i.adjugate[3] = e[4] * e[5] - e[3] * e[2];
    i.adjugate[4] = e[3] * e[5] - e[4] * e[1];
    i.adjugate[5] = e[3] * e[4] - e[0] * e[5];
    i.a = e[0] + e[1] + e[2];
    i.b = i.adjugate[0] + i.adjugate[1] + i.adjugate[2];
    i.c = e[0] * i.adjugate[0] + e[3] * i.adjugate[3] + e[4] * i.adjugate[4];
    i.squared = i.a * i.a - 2.0f * i.b;
    return i;
}

template <class S> COROT_INLINE Invariants<S> invariants_of(const S* e, const S& det) {
    Invariants<S> i = invariants_of(e);
    i.small = (i.squared < 0.4f) & (det > 0.0f);
    i.j = i.small ? over(i.a + i.b + i.c, 1.0f + det) : det - 1.0f;
    return i;
}

// q, 16 at rest, below which R is not trusted: the root has lost digits, or is about to meet another.
template <class S> constexpr float INDEFINITE = IS_FINE<S> ? 1e-3f : 1.0f;

// What polynomials of the stretch S are made of. With t = tr S - 3, j = J - 1 and the invariants a, b, c of E, t is the
// largest root of the quartic (Cayley-Hamilton for S; x = t + 3 is the largest eigenvalue of Horn's 4x4 matrix)
//     t^4 + 12 t^3 + (48 - 2a) t^2 + (64 - 12a - 8j) t + a^2 - 20a - 24j - 4b = 0
// whose slope is 4q, q = 2 (s1 + s2)(s1 + s3)(s2 + s3) of the principal stretches: no root is better defined. ``valid``
// where q and the root are good.
template <class S> struct Stretch {
    Invariants<S> of;
    S t, q, volume;
    mask_of<S> valid;
};

// Of single floats: in a fixed number of steps, where F is neither flat, turned over (J up to ``FLAT``) nor far from order one;
// there J - 1 comes from E, however large it is.
constexpr float FLAT = 0.03f, FAR = 50.0f;

COROT_INLINE Stretch<float> stretch_of(const float* e, const float& det) {
    Stretch<float> s;
    s.of = invariants_of(e);
    const float a = s.of.a, b = s.of.b, c = s.of.c, p2 = s.of.squared;
    // A comparison with NaN is false.
    s.valid = det > FLAT && a < FAR;
    s.of.small = true;
    if (!s.valid) return s;
    const float j = s.of.j = over(a + b + c, 1.0f + det);
    // The series of tr sqrt(I + E).
    const float p3 = a * (p2 - b) + 3.0f * c, p4 = a * (p3 + c) - b * p2;
    float t = 0.5f * a + 0.0625f * p3 - 0.125f * p2 - 0.0390625f * p4;
    if (p2 >= 0.4f) {
        // Where it ends too early: x = tr S from x^2 = tr C + 2 y, y^2 = tr adj C + 2 J x, from x <= sqrt(3 tr C) on. In each
        // round the error shrinks to a ninth or less.
        const float first = a + 3.0f, second = b + 2.0f * a + 3.0f, twice = 2.0f + 2.0f * j;
        float x = root(3.0f * first);
        for (int round = 0; round < 2; ++round) x = root(first + 2.0f * root(second + twice * x));
        t = x - 3.0f;
    }
    const float c0 = a * (a - 20.0f) - 24.0f * j - 4.0f * b, c1 = 64.0f - 12.0f * a - 8.0f * j, c2 = 48.0f - 2.0f * a;
    const auto step_of = [&](float t) {
        return over((((t + 12.0f) * t + c2) * t + c1) * t + c0, ((4.0f * t + 36.0f) * t + 2.0f * c2) * t + c1);
    };
    // From a step of 1e-4 x, Newton's iteration leaves at most some 1e-7.
    const float step = step_of(t);
    t -= step;
    if (magnitude(step) > 1.0e-4f * (t + 3.0f)) t -= step_of(t);
    s.t = t, s.volume = det;
    s.q = 16.0f + t * (24.0f + t * (9.0f + t)) - a * (3.0f + t) - 2.0f * j;
    return s;
}

template <class S> COROT_INLINE Stretch<S> stretch_of(const S* e, const S& det) {
    Stretch<S> s;
    s.of = invariants_of(e, det);
    const S &a = s.of.a, &b = s.of.b, &c = s.of.c, &j = s.of.j;
    const S c0 = a * a - 20.0f * a - 24.0f * j - 4.0f * b, c1 = 64.0f - 12.0f * a - 8.0f * j;
    const S c2 = 48.0f - 2.0f * a;
    // The series of tr sqrt(I + E), or from above, where the iteration cannot miss the root.
    S t = 0.5f * a;
    const S &p2 = s.of.squared, p3 = a * p2 - b * a + 3.0f * c, p4 = a * p3 - b * p2 + c * a;
    const S p5 = a * p4 - b * p3 + c * p2;
    t = s.of.small ? t - 0.125f * p2 + 0.0625f * p3 - 0.0390625f * p4 + 0.02734375f * p5 : t;
    mask_of<S> open = t == t;
    const float settled = IS_FINE<S> ? 1e-18f : 1e-8f;
    for (int iteration = 0; iteration < (IS_FINE<S> ? 50 : 24); ++iteration) {
        const S value = (((t + 12.0f) * t + c2) * t + c1) * t + c0;
        const S slope = ((4.0f * t + 36.0f) * t + 2.0f * c2) * t + c1;
        const S step = value / slope;
        t = open ? t - step : t;
        open &= step * step > settled * (t + 3.0f) * (t + 3.0f);
        if (!any(open)) break;
    }
    if constexpr (same<S, dual>::value) {
        // The derivative of the root, which lags behind it by an iteration.
        const double x = t.value, slope = ((4.0 * x + 36.0) * x + 2.0 * c2.value) * x + c1.value;
        t.slope = -((c2.slope * x + c1.slope) * x + c0.slope) / slope;
    }
    s.t = t, s.volume = 1.0f + j;
    s.q = 16.0f + t * (24.0f + t * (9.0f + t)) - a * (3.0f + t) - 2.0f * j;
    s.valid = inverted(open) & (s.q > INDEFINITE<S>) & (a < 1000.0f);
    return s;
}

// The columns r of R times the frame, R = ((x^2 + tr C) F + 2 x cof F - 2 F C) / q, for every F of which q is not small,
// flattened and turned over too; and where they may be trusted.
template <class D, class S> COROT_INLINE mask_of<S> rotation_of(const D& d, triple<S>* r) {
    const triple<S>* f = d.f;
    const triple<S> last = cross(f[0], f[1]);
    const auto handedness = handedness_of(d.frame);
    const Stretch<S> s = stretch_of(d.e, handedness * dot(f[2], last));
    const S w = 1.0f / s.q;
    S sigma[6];
    for (int i = 0; i < 6; ++i) sigma[i] = -2.0f * w * d.e[i];
    for (int i = 0; i < 3; ++i) sigma[i] += w * (10.0f + s.t * (6.0f + s.t) + s.of.a);
    times(f, sigma, r);
    const S v = 2.0f * (3.0f + s.t) * w * handedness;
    r[0] = added(r[0], v, cross(f[1], f[2]));
    r[1] = added(r[1], v, cross(f[2], f[0]));
    r[2] = added(r[2], v, last);
    return s.valid;
}

}  // namespace corot
