// The law of Holzapfel, Gasser and Ogden; see corotated/anisotropic.py.
#pragma once

#include "laws.h"

namespace corot {

// k2 e^2 beyond which the energy is a parabola: ln(100); and the k2 below which fibres stiffen too little for float to see.
constexpr float MOST_STIFFENING = 4.605170f, LEAST_STIFFENING = 1.0e-6f;

// Cosine and sine of angles from 0 to pi / 2, by series of what is less than pi / 4.
template <class S> COROT_INLINE void cosine_and_sine(const S& angle, S& cosine, S& sine) {
    const mask_of<S> steep = angle > 0.78539816f;
    const S y = steep ? 1.57079633f - angle : angle, z = y * y;
    const S small = y * (1.0f - z * (1.0f / 6) * (1.0f - z * (1.0f / 20) * (1.0f - z * (1.0f / 42) * (1.0f - z * (1.0f / 72)))));
    const S large = 1.0f - z * 0.5f * (1.0f - z * (1.0f / 12) * (1.0f - z * (1.0f / 30) * (1.0f - z * (1.0f / 56)
        * (1.0f - z * (1.0f / 90)))));
    cosine = steep ? small : large;
    sine = steep ? large : small;
}

// Matrix, fibres and active stress of a ``ReinforcedMaterial``; FILLED: fibres count as far as an element is filled, as its
// matrix does.
template <class Material, bool FILLED> struct Fibres {
    const Material& material;
    template <class Nodes> COROT_INLINE void begin(const Nodes&) {}

    // The fibres of an element: k1, k2, the dispersion and the angle; how many directions they have; and the first axis.
    template <class N> struct Families {
        N numbers[4], held;
        triple<N> along, first, second;
        mask_of<N> have_two;
    };

    template <class D, class At> COROT_INLINE Families<typename At::N> families(const D& d, const At& at) const {
        typedef typename At::N N;
        const auto& fibres = material.fibres;
        Families<N> of;
        N turn[9], c, s;
        gather_numbers<9>(at, [&](int t) { return &fibres.axes.data[t].data[0][0]; }, fibres.axes_stride, turn);
        gather_numbers<4>(at, [&](int t) { return &fibres.stiffness.data[t][0]; }, fibres.stride, of.numbers);
        of.along = into_frame(d.frame, triple<N>{turn[0], turn[3], turn[6]});
        const triple<N> beside = into_frame(d.frame, triple<N>{turn[1], turn[4], turn[7]});
        const N& angle = of.numbers[3];
        of.held = FILLED ? at.weight() * at.value(fibres.fill, fibres.fill_stride) : at.weight();
        cosine_and_sine(angle, c, s);
        of.first = of.along * c + beside * s;
        of.second = of.along * c - beside * s;
        of.have_two = angle > 0.0f;
        return of;
    }

    template <class D, class At, class S = typename D::S> COROT_INLINE mask_of<S> stress(const D& d, const At& at, triple<S>* p) const {
        typedef typename At::N N;
        const mask_of<S> valid = elastic(NeoHookean{}, material.matrix).stress(d, at, p);
        const Families<N> of = families(d, at);
        add_family(d, of.numbers, of.first, of.held, p);
        if (any(of.have_two)) add_family(d, of.numbers, of.second, of.have_two ? of.held : spread<N>(0.0f), p);
        if (material.is_active) pull(d, of.along, N(of.held * at.values_of(material.activation.data)), p);
        return valid;
    }

    // Active stress has no energy density.
    template <class D> COROT_INLINE float energy(const D& d, const Single& at) const {
        const Families<float> of = families(d, at);
        float unused, sum = energy_of(strain_of(d, of.numbers[2], of.first, unused), of.numbers[0], of.numbers[1]);
        if (of.have_two) sum += energy_of(strain_of(d, of.numbers[2], of.second, unused), of.numbers[0], of.numbers[1]);
        return elastic(NeoHookean{}, material.matrix).energy(d, at) + of.held * sum;
    }

    template <class N> static COROT_INLINE N rate_of(const N& k2) { return k2 < LEAST_STIFFENING ? spread<N>(LEAST_STIFFENING) : k2; }

    // phi' of a fibre strain, and phi.
    template <class S, class N> static COROT_INLINE S slope(const S& e, const N& k1, const N& k2) {
        const N rate = rate_of(k2), most = root(over(spread<N>(MOST_STIFFENING), rate));
        const S inside = e < 0.0f ? spread<S>(0.0f) : e > most ? S(most) : e;
        const S x = rate * inside * inside, grown = k1 * (1.0f + power_excess(x));
        const S beyond = e > inside ? e - inside : spread<S>(0.0f);
        return grown * (inside + (e > 0.0f ? (1.0f + 2.0f * x) * beyond : spread<S>(0.0f)));
    }

    static COROT_INLINE float energy_of(float e, float k1, float k2) {
        const float rate = rate_of(k2), most = root(over(MOST_STIFFENING, rate));
        const float inside = e < 0.0f ? 0.0f : e > most ? most : e, beyond = e > most ? e - most : 0.0f;
        const float x = rate * inside * inside, excess = power_excess(x), grown = k1 * (1.0f + excess);
        return 0.5f * over(k1 * excess, rate) + beyond * grown * (inside + 0.5f * (1.0f + 2.0f * x) * beyond);
    }

    // Adds w F (v v^T).
    template <class D, class N, class W, class S> static COROT_INLINE void pull(const D& d, const triple<N>& v, const W& w, triple<S>* p) {
        const triple<S> pulled = combined(v.x, d.f[0], v.y, d.f[1], v.z, d.f[2]) * w;
        p[0] = added(p[0], v.x, pulled);
        p[1] = added(p[1], v.y, pulled);
        p[2] = added(p[2], v.z, pulled);
    }

    // The strain of a direction with a dispersion, and the share of what is along it.
    template <class D, class N, class S = typename D::S>
    static COROT_INLINE S strain_of(const D& d, const N& kappa, const triple<N>& v, N& along) {
        const S* e = d.e;
        along = 1.0f - 3.0f * kappa;
        const triple<S> rows = {dot(triple<S>{e[0], e[3], e[4]}, v), dot(triple<S>{e[3], e[1], e[5]}, v), dot(triple<S>{e[4], e[5], e[2]}, v)};
        return kappa * (e[0] + e[1] + e[2]) + along * dot(v, rows);
    }

    // Adds a weight times the stress of the family of a direction; ``numbers`` are k1, k2 and the dispersion.
    template <class D, class N, class S = typename D::S>
    static COROT_INLINE void add_family(const D& d, const N* numbers, const triple<N>& v, const N& w, triple<S>* p) {
        N along;
        const S strain = strain_of(d, numbers[2], v, along);
        const S stress = (2.0f * w) * slope(strain, numbers[0], numbers[1]);
        for (int j = 0; j < 3; ++j) p[j] = added(p[j], numbers[2] * stress, d.f[j]);
        pull(d, v, along * stress, p);
    }
};

template <bool FILLED = true, class Material> COROT_INLINE Fibres<Material, FILLED> fibres(const Material& material) { return {material}; }

}  // namespace corot
