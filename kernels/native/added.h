// Stresses beside a law: viscosity, the Maxwell elements of a Prony series, and one that a body has at rest; see
// elements/added.py.
#pragma once

#include "elements8.h"

namespace corot {

// Below this determinant of tr(U) I - U the turning of an element is hardly determined.
constexpr float LEAST_TURNING = 0.05f;

// The viscous stress of columns f of F, r of R and c of the rate of F, all times one frame, and of viscosities m and k.
template <class S>
COROT_INLINE void viscous_stress(const triple<S>* f, const triple<S>* r, const triple<S>* c, const S& m, const S& k, triple<S>* p) {
    // U: 00, 11, 22, 01, 02, 12. M = tr U I - U, and its inverse times its determinant.
    const S stretch[6] = {dot(r[0], f[0]), dot(r[1], f[1]), dot(r[2], f[2]), 0.5f * (dot(r[0], f[1]) + dot(r[1], f[0])),
        0.5f * (dot(r[0], f[2]) + dot(r[2], f[0])), 0.5f * (dot(r[1], f[2]) + dot(r[2], f[1]))};
    const triple<S> u[3] = {{stretch[0], stretch[3], stretch[4]}, {stretch[3], stretch[1], stretch[5]},
        {stretch[4], stretch[5], stretch[2]}};
    const triple<S> turn[3] = {{stretch[1] + stretch[2], -stretch[3], -stretch[4]},
        {-stretch[3], stretch[0] + stretch[2], -stretch[5]}, {-stretch[4], -stretch[5], stretch[0] + stretch[1]}};
    const triple<S> adjugate[3] = {cross(turn[1], turn[2]), cross(turn[2], turn[0]), cross(turn[0], turn[1])};
    const S det = dot(turn[0], adjugate[0]);
    const mask_of<S> crushed = (det < LEAST_TURNING) | (dot(u[0], cross(u[1], u[2])) < 0.0f);
    const S inverse = crushed ? spread<S>(0.0f) : over(1.0f, det);
    const auto solve = [&](const triple<S>& x) {
        return triple<S>{dot(adjugate[0], x) * inverse, dot(adjugate[1], x) * inverse, dot(adjugate[2], x) * inverse};
    };
    // Columns of A, then of A - W U.
    triple<S> a[3];
    for (int j = 0; j < 3; ++j) a[j] = {dot(r[0], c[j]), dot(r[1], c[j]), dot(r[2], c[j])};
    const triple<S> w = solve({a[1].z - a[2].y, a[2].x - a[0].z, a[0].y - a[1].x});
    for (int j = 0; j < 3; ++j) a[j] = a[j] - cross(w, u[j]);
    const S pressure = k * (a[0].x + a[1].y + a[2].z), twice = 2.0f * m;
    const S s01 = m * (a[0].y + a[1].x), s02 = m * (a[0].z + a[2].x), s12 = m * (a[1].z + a[2].y);
    triple<S> s[3] = {{twice * a[0].x + pressure, s01, s02}, {s01, twice * a[1].y + pressure, s12},
        {s02, s12, twice * a[2].z + pressure}};
    // The axial vector of U s, from products of columns.
    const triple<S> turning = solve({dot(u[2], s[1]) - dot(u[1], s[2]), dot(u[0], s[2]) - dot(u[2], s[0]),
        dot(u[1], s[0]) - dot(u[0], s[1])});
    s[0] = s[0] + triple<S>{spread<S>(0.0f), turning.z, -turning.y};
    s[1] = s[1] + triple<S>{-turning.z, spread<S>(0.0f), turning.x};
    s[2] = s[2] + triple<S>{turning.y, -turning.x, spread<S>(0.0f)};
    for (int j = 0; j < 3; ++j) p[j] = combined(s[j].x, r[0], s[j].y, r[1], s[j].z, r[2]);
}

#if !defined(__CUDACC__)
// The viscous stress of a ``ViscousMaterial``.
template <class Material> struct Viscous {
    const Material& material;
    triple<lanes8> velocities[10];  // of four or ten nodes
    template <class Nodes> COROT_INLINE void begin(const Nodes& nodes) { nodes.gather_nodes(material.velocities, velocities); }
    template <class D, class At> COROT_INLINE masks8 stress(const D& d, const At& at, triple<lanes8>* p) const {
        const auto& isotropic = material.isotropic;
        const lanes8 weight = material.seconds * at.weight();
        triple<lanes8> r[3], c[3];
        const masks8 valid = rotation_of(d, r);
        at.columns(velocities, c);
        viscous_stress(d.f, r, c, weight * at.value(isotropic.mu, isotropic.stride),
            weight * at.value(isotropic.lam, isotropic.stride), p);
        for (int j = 0; j < 3; ++j) p[j] = chosen(valid, p[j], nothing<lanes8>());
        return valid;
    }
};

template <class Material> COROT_INLINE Viscous<Material> viscous(const Material& material) { return {material, {}}; }
#endif

// The Maxwell elements of a ``PronyMaterial``.
template <class Material> struct Prony {
    const Material& material;
    template <class Nodes> COROT_INLINE void begin(const Nodes&) {}

    // The numbers of an element, or of eight, one after the other from ``known``.
    COROT_INLINE const float* known(int block, int i) const {
        return material.known.data + (6 * block + i) * static_cast<unsigned long long>(material.count);
    }

    // exp(-t / tau) of a term, and the share of a change that is left.
    COROT_INLINE void fade(int term, float time, float& left, float& mean) const {
        const float x = time / material.tau.data[term];
        left = power_of(-x);
        mean = x > 0.02f ? (1.0f - left) / x : 1.0f - 0.5f * x * (1.0f - x / 3.0f * (1.0f - 0.25f * x));
    }

    // The deviator of Green's strain in the axes of rest space, and its change since the known state.
    template <class D, class At, class S = typename D::S> COROT_INLINE void strain_of(const D& d, const At& at, S* strain, S* change) const {
        S e[6];
        const S mean = (d.e[0] + d.e[1] + d.e[2]) * (1.0f / 6);
        for (int i = 0; i < 6; ++i) e[i] = i < 3 ? 0.5f * d.e[i] - mean : 0.5f * d.e[i];
        out_of_frame(d.frame, e, strain);
        for (int i = 0; i < 6; ++i) change[i] = strain[i] - at.values_of(known(0, i));
    }

    template <class D, class At, class S = typename D::S> COROT_INLINE mask_of<S> stress(const D& d, const At& at, triple<S>* p) const {
        S strain[6], change[6], sum[6], second[6];
        strain_of(d, at, strain, change);
        for (int i = 0; i < 6; ++i) sum[i] = spread<S>(0.0f);
        for (int term = 0; term < material.g.shape[0]; ++term) {
            float left, mean;
            fade(term, material.elapsed.data[0], left, mean);
            const float g = material.g.data[term];
            for (int i = 0; i < 6; ++i) sum[i] += (g * left) * at.values_of(known(term + 1, i)) + (g * mean) * change[i];
        }
        into_frame(d.frame, sum, second);
        const auto twice = 2.0f * at.weight() * at.value(material.isotropic.mu, material.isotropic.stride);
        for (int i = 0; i < 6; ++i) second[i] = second[i] * twice;
        times(d.f, second, p);
        return every<S>();
    }

    template <class D> COROT_INLINE float energy(const D& d, const Single& at) const {
        float strain[6], change[6], sum = 0.0f;
        strain_of(d, at, strain, change);
        for (int term = 0; term < material.g.shape[0]; ++term) {
            float left, mean, density = 0.0f;
            fade(term, material.elapsed.data[0], left, mean);
            for (int i = 0; i < 6; ++i) {
                const float s = at.values_of(known(term + 1, i));
                density += (i < 3 ? 1.0f : 2.0f) * (mean * change[i] * change[i] + left * s * (2.0f * change[i] + s));
            }
            sum += material.g.data[term] * density;
        }
        return sum * at.value(material.isotropic.mu, material.isotropic.stride);
    }

    // Makes the state a time later, at a deformation of an element or of eight consecutive ones, the known one.
    template <class D, class At, class S = typename D::S> COROT_INLINE void relax(const D& d, const At& at, float time) const {
        S strain[6], change[6];
        strain_of(d, at, strain, change);
        for (int term = 0; term < material.g.shape[0]; ++term) {
            float left, mean;
            fade(term, time, left, mean);
            for (int i = 0; i < 6; ++i) at.write(known(term + 1, i), left * at.values_of(known(term + 1, i)) + mean * change[i]);
        }
        for (int i = 0; i < 6; ++i) at.write(known(0, i), strain[i]);
    }
};

// The stress F S of a ``Prestress`` S, in the axes of rest space.
template <class Material> struct Prestressed {
    const Material& material;
    template <class Nodes> COROT_INLINE void begin(const Nodes&) {}
    template <class D, class At, class S = typename D::S> COROT_INLINE mask_of<S> stress(const D& d, const At& at, triple<S>* p) const {
        typedef typename At::N N;
        N s[9], turned[6];
        gather_numbers<9>(at, [&](int t) { return &material.stress.data[t].data[0][0]; }, material.stride, s);
        const N six[6] = {s[0], s[4], s[8], s[1], s[2], s[5]};
        into_frame(d.frame, six, turned);
        for (int i = 0; i < 6; ++i) turned[i] *= at.weight();
        times(d.f, turned, p);
        return every<S>();
    }
    template <class D> COROT_INLINE float energy(const D& d, const Single& at) const {
        float e[6], s[9];
        out_of_frame(d.frame, d.e, e);
        gather_numbers<9>(at, [&](int t) { return &material.stress.data[t].data[0][0]; }, material.stride, s);
        return 0.5f * (s[0] * e[0] + s[4] * e[1] + s[8] * e[2]) + s[1] * e[3] + s[2] * e[4] + s[5] * e[5];
    }
};

template <class Material> COROT_INLINE Prestressed<Material> prestressed(const Material& material) { return {material}; }

template <class Material> COROT_INLINE Prony<Material> prony(const Material& material) { return {material}; }

#if !defined(__CUDACC__)
template <template <class> class Traversal, class Material, class Units, class Vectors>
COROT_INLINE void relax_eight(const Material& material, const Units& units, int block, int count, const Vectors& u, float time) {
    const Traversal<Units> at(units, 8 * block, count);
    triple<lanes8> a[3];
    gradient_of(at, u, a);
    prony(material).relax(deformation_of(a, at.frame), at, time);
}
#endif

}  // namespace corot
