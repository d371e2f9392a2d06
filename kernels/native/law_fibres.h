// The law of Holzapfel, Gasser and Ogden; see elements/fibres.py.
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

// Matrix, fibres and active stress of a ``ReinforcedMaterial``.
template <class Material> struct Fibres {
    const Material& material;
    template <class Nodes> COROT_INLINE void begin(const Nodes&) {}

    template <class D, class At> COROT_INLINE masks8 stress(const D& d, const At& at, triple<lanes8>* p) const {
        const auto& fibres = material.fibres;
        const masks8 valid = elastic(NeoHookean{}, material.matrix).stress(d, at, p);
        lanes8 turn[9], numbers[4], c, s;
        gather_numbers<9>(at, [&](int t) { return fibres.axes.data[t].data[0]; }, fibres.axes_stride, turn);
        gather_numbers<4>(at, [&](int t) { return &fibres.stiffness.data[t][0]; }, fibres.stride, numbers);
        const triple<lanes8> along = into_frame(d.frame, triple<lanes8>{turn[0], turn[3], turn[6]});
        const triple<lanes8> beside = into_frame(d.frame, triple<lanes8>{turn[1], turn[4], turn[7]});
        const lanes8 &angle = numbers[3], held = at.weight() * at.value(fibres.fill, fibres.fill_stride);
        cosine_and_sine(angle, c, s);
        add_family(d, numbers, along * c + beside * s, held, p);
        const masks8 have_two = angle > 0.0f;
        if (any(have_two)) add_family(d, numbers, along * c - beside * s, have_two ? held : spread<lanes8>(0.0f), p);
        if (material.is_active) pull(d, along, held * at.values_of(material.activation.data), p);
        return valid;
    }

    // phi' of a fibre strain.
    static COROT_INLINE lanes8 slope(const lanes8& e, const lanes8& k1, const lanes8& k2) {
        const lanes8 rate = k2 < LEAST_STIFFENING ? spread<lanes8>(LEAST_STIFFENING) : k2;
        const lanes8 most = root(MOST_STIFFENING / rate);
        const lanes8 inside = e < 0.0f ? spread<lanes8>(0.0f) : e > most ? most : e;
        const lanes8 x = rate * inside * inside, grown = k1 * (1.0f + power_excess(x));
        const lanes8 beyond = e > inside ? e - inside : spread<lanes8>(0.0f);
        return grown * (inside + (e > 0.0f ? (1.0f + 2.0f * x) * beyond : spread<lanes8>(0.0f)));
    }

    // Adds w F (v v^T).
    template <class D> static COROT_INLINE void pull(const D& d, const triple<lanes8>& v, const lanes8& w, triple<lanes8>* p) {
        const triple<lanes8> pulled = combined(v.x, d.f[0], v.y, d.f[1], v.z, d.f[2]) * w;
        p[0] = added(p[0], v.x, pulled);
        p[1] = added(p[1], v.y, pulled);
        p[2] = added(p[2], v.z, pulled);
    }

    // Adds a weight times the stress of the family of a direction; ``numbers`` are k1, k2 and the dispersion.
    template <class D>
    static COROT_INLINE void add_family(const D& d, const lanes8* numbers, const triple<lanes8>& v, const lanes8& w, triple<lanes8>* p) {
        const lanes8 &kappa = numbers[2], *e = d.e, others = 1.0f - 3.0f * kappa;
        const triple<lanes8> rows = {dot({e[0], e[3], e[4]}, v), dot({e[3], e[1], e[5]}, v), dot({e[4], e[5], e[2]}, v)};
        const lanes8 strain = kappa * (e[0] + e[1] + e[2]) + others * dot(v, rows);
        const lanes8 stress = 2.0f * w * slope(strain, numbers[0], numbers[1]);
        for (int j = 0; j < 3; ++j) p[j] = added(p[j], kappa * stress, d.f[j]);
        pull(d, v, others * stress, p);
    }
};

template <class Material> COROT_INLINE Fibres<Material> fibres(const Material& material) { return {material}; }

}  // namespace corot
