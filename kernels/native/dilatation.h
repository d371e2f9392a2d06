// The dilatation that elements share; see elements/dilatation.py. A kind of it has ``theta`` of an element, the columns p
// of d theta / dF, w' of a mean theta (``pressure``) and h' of an element's own (``holding``); ``energy`` and
// ``held_energy`` are w and h.
#pragma once

#include "laws.h"

namespace corot {

// The columns of the axes, and of F: sums with those of A.
template <class S, class N> COROT_INLINE void add_axes(const Frame<N>& frame, triple<S>* f) {
    for (int j = 0; j < 3; ++j) f[j] = f[j] + frame.q[j];
}

template <class S, class N> COROT_INLINE void add_axes(const RestAxes<N>&, triple<S>* f) {
    f[0].x += 1.0f, f[1].y += 1.0f, f[2].z += 1.0f;
}

template <class S, class N> COROT_INLINE S trace_of(const triple<S>* a, const Frame<N>& frame) {
    return dot(a[0], frame.q[0]) + dot(a[1], frame.q[1]) + dot(a[2], frame.q[2]);
}

template <class S, class N> COROT_INLINE S trace_of(const triple<S>* a, const RestAxes<N>&) { return a[0].x + a[1].y + a[2].z; }

struct SquareEnergy {
    template <class S> static COROT_INLINE S pressure(const S& theta) { return theta; }
    static COROT_INLINE float energy(float theta) { return 0.5f * theta * theta; }
};

struct NotHeld {
    template <class S> static COROT_INLINE S holding(const S&) { return spread<S>(0.0f); }
    static COROT_INLINE float held_energy(float) { return 0.0f; }
};

// Linear elasticity: theta = tr e.
struct SmallDilatation : SquareEnergy, NotHeld {
    template <class S, class Axes> static COROT_INLINE S theta(const triple<S>* a, const Axes& axes) {
        return trace_of(a, axes);
    }
    template <class S, class Axes> static COROT_INLINE void slopes(const triple<S>*, const Axes& axes, triple<S>* p) {
        for (int j = 0; j < 3; ++j) p[j] = nothing<S>();
        add_axes(axes, p);
    }
};

// St. Venant-Kirchhoff: theta = tr E.
struct GreenDilatation : SquareEnergy, NotHeld {
    template <class S, class Axes> static COROT_INLINE S theta(const triple<S>* a, const Axes& axes) {
        return trace_of(a, axes) + 0.5f * (dot(a[0], a[0]) + dot(a[1], a[1]) + dot(a[2], a[2]));
    }
    template <class S, class Axes> static COROT_INLINE void slopes(const triple<S>* a, const Axes& axes, triple<S>* p) {
        for (int j = 0; j < 3; ++j) p[j] = a[j];
        add_axes(axes, p);
    }
};

// |J - 1| up to which an element is free to differ from its group, and the range over which its stiffness grows from there.
constexpr float FREE = 0.25f, RAMP = 0.5f;

// theta = J - 1, with the digits of small strains.
struct VolumeChange {
    template <class S, class Axes> static COROT_INLINE S theta(const triple<S>* a, const Axes& axes) {
        return volume_change(a, axes);
    }
    template <class S, class Axes> static COROT_INLINE void slopes(const triple<S>* a, const Axes& axes, triple<S>* p) {
        triple<S> f[3] = {a[0], a[1], a[2]};
        add_axes(axes, f);
        const auto handedness = handedness_of(axes);
        p[0] = cross(f[1], f[2]) * handedness;
        p[1] = cross(f[2], f[0]) * handedness;
        p[2] = cross(f[0], f[1]) * handedness;
    }
    template <class S> static COROT_INLINE S holding(const S& theta) {
        const S size = theta < 0.0f ? -theta : theta, beyond = size > FREE ? size - FREE : spread<S>(0.0f);
        const S near = beyond < RAMP ? beyond : spread<S>(RAMP), slope = (0.5f / RAMP) * near * near + (beyond - near);
        return theta < 0.0f ? -slope : slope;
    }
    static COROT_INLINE float held_energy(float theta) {
        const float size = theta < 0.0f ? -theta : theta, beyond = size > FREE ? size - FREE : 0.0f;
        const float near = beyond < RAMP ? beyond : RAMP, far = beyond - near, slope = (0.5f / RAMP) * near * near;
        return near * slope * (1.0f / 3) + far * (slope + 0.5f * far);
    }
};

// Corotated: w = theta^2 / 2.
struct VolumeDilatation : VolumeChange, SquareEnergy {};

// Neo-Hookean: w = (ln J)^2 / 2, continued below J0 = CONTINUED_BELOW.
struct LogVolumeDilatation : VolumeChange {
    template <class S> static COROT_INLINE S pressure(const S& theta) {
        return volumetric_slope(theta, 0.0f, 1.0f);
    }
    static COROT_INLINE float energy(float theta) {
        const float low = CONTINUED_BELOW - 1.0f, inside = theta < low ? low : theta, step = theta - inside;
        const float log = log_of(inside), over_j = over(1.0f, 1.0f + inside);
        return 0.5f * log * log + step * over_j * (log + 0.5f * over_j * (1.0f - log) * step);
    }
};

// Adds a weight times the stress of an element's dilatation theta and a shared one whose w' is ``pressure``.
template <class Of, class D, class S = typename D::S>
COROT_INLINE void add_pressure(const D& d, const S& theta, const S& pressure, const S& weight, triple<S>* p) {
    triple<S> slopes[3];
    Of::slopes(d.a, d.frame, slopes);
    const S w = weight * (pressure + Of::holding(theta));
    for (int j = 0; j < 3; ++j) p[j] = added(p[j], w, slopes[j]);
}

#if !defined(__CUDACC__)
// A law whose elements share a dilatation: all those that a traversal of subtrees gathers in a lane. The law's own lambda is
// zero; this one is in ``lam``.
template <class Of, class Law, class Values> struct Dilating {
    Law law;
    const Values& lam;
    const int stride;
    lanes8 pressure;
    template <class Nodes> COROT_INLINE void begin(const Nodes& nodes) {
        law.begin(nodes);
        lanes8 sum = spread<lanes8>(0.0f), weight = spread<lanes8>(0.0f);
#if defined(__clang__)
#pragma clang loop unroll(disable)
#endif
        for (int leaf = 0; leaf < nodes.LEAVES; ++leaf) {
            const auto at = nodes.leaf(leaf);
            const lanes8 share = at.value(lam, stride);
            triple<lanes8> a[3];
            at.columns(nodes.x, a);
            sum += share * Of::theta(a, at.frame);
            weight += share;
        }
        const masks8 weighted = weight != 0.0f;
        pressure = Of::pressure(weighted ? sum / weight : spread<lanes8>(0.0f));
    }
    template <class D, class At>
    COROT_INLINE masks8 stress(const D& d, const At& at, triple<lanes8>* p) const {
        const masks8 valid = law.stress(d, at, p);
        add_pressure<Of>(d, Of::theta(d.a, d.frame), pressure, at.weight() * at.value(lam, stride), p);
        return valid;
    }
};

template <class Of, class Law, class Values>
COROT_INLINE Dilating<Of, Law, Values> dilating(const Law& law, const Values& lam, int stride) {
    return {law, lam, stride, spread<lanes8>(0.0f)};
}
#endif

}  // namespace corot
