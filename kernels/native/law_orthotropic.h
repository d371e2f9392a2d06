// The corotated law of orthotropic materials, and active stress; see corotated/anisotropic.py and its neighbours.
#pragma once

#include "elements8.h"
#include "law_anisotropic.h"

namespace corot {

// (det(tr(S) I - S) / |S|^3)^2 times four, where leaves of no definite rotation begin: twice 0.41, squared.
constexpr float NEARLY_INDEFINITE = 0.82f * 0.82f;

// The columns of P of strains and rotations that are definite.
COROT_INLINE void law_of(const lanes8* c, const lanes8* e, const triple<lanes8>* r, triple<lanes8>* p) {
    lanes8 s[6];
    orthotropic_stress(c, e, s);
    const lanes8 h[3] = {2.0f + e[1] + e[2], 2.0f + e[0] + e[2], 2.0f + e[0] + e[1]};
    lanes8 adjugate[6];
    const lanes8 det = turning_adjugate(h, e, adjugate);
    turned_columns(s, applied(adjugate, commutator(e, s)) * (1.0f / det), r, p);
}

// Corotated forces of orthotropic elements and of their active stress, under a ``FibreMaterial``. Elements of no definite rotation
// are left out.
template <class Material> struct ActiveOrthotropic {
    const Material& material;
    template <class Nodes> COROT_INLINE void begin(const Nodes&) {}
    template <class D, class At> COROT_INLINE masks8 stress(const D& given, const At& at, triple<lanes8>* p) const {
        const auto& passive = material.passive;
        lanes8 m[9], k[9];
        gather_numbers<9>(at, [&](int t) { return passive.axes.data[t].data[0]; }, passive.axes_stride, m);
        gather_numbers<9>(at, [&](int t) { return &passive.stiffness.data[t][0]; }, passive.stride, k);
        // The material's axes M in the frame, columns of G M and of F M, and E in the axes.
        const Frame<lanes8> axes = {{{m[0], m[3], m[6]}, {m[1], m[4], m[7]}, {m[2], m[5], m[8]}}, spread<lanes8>(1.0f)};
        triple<lanes8> n[3], a[3], r[3], stress[3];
        for (int j = 0; j < 3; ++j) {
            n[j] = into_frame(given.frame, axes.q[j]);
            a[j] = combined(n[j].x, given.a[0], n[j].y, given.a[1], n[j].z, given.a[2]);
        }
        const auto d = deformation_of(a, axes);
        const triple<lanes8>* c = d.f;
        const lanes8* e = d.e;
        // Where E is small, S - I is a polynomial of it, with its digits, and R = F (I - (I - S^-1)); elsewhere R^T F - I.
        const Stretch<lanes8> s = stretch_of(e, dot(c[0], cross(c[1], c[2])));
        const masks8 small = s.of.small;
        const lanes8 &ia = s.of.a, &ib = s.of.b, &ic = s.of.c, &ij = s.of.j, &it = s.t;
        const lanes8 y = (2.0f * it - 6.0f * ij) / (1.0f + ij), over_q = 1.0f / s.q;
        const lanes8 n0 = over_q * (it * (18.0f + it * (8.0f + it)) - ia * (10.0f + it) - 2.0f * ij - y * (1.0f + ia));
        const lanes8 n1 = over_q * (8.0f + y), n2 = -over_q * (6.0f + y);
        lanes8 sigma[6], strain[6];
        for (int i = 0; i < 6; ++i) {
            sigma[i] = -n1 * e[i] - n2 * s.of.adjugate[i];
            strain[i] = (1.0f - n1 - n0 - n1 * ia) * e[i] - (n1 + n2) * s.of.adjugate[i];
        }
        for (int i = 0; i < 3; ++i) { sigma[i] += 1.0f - n0; strain[i] += n1 * ib - n2 * ic - n0; }
        times(c, sigma, r);
        const masks8 valid = s.valid & (s.q * s.q > NEARLY_INDEFINITE * (3.0f + ia) * (3.0f + ia) * (3.0f + ia));
        if (any(~small)) {
            triple<lanes8> other[3];
            rotation_of(d, other);
            for (int j = 0; j < 3; ++j) {
                r[j] = chosen(small, r[j], other[j]);
                strain[j] = small ? strain[j] : dot(other[j], c[j]) - 1.0f;
            }
            strain[3] = small ? strain[3] : 0.5f * (dot(other[0], c[1]) + dot(other[1], c[0]));
            strain[4] = small ? strain[4] : 0.5f * (dot(other[0], c[2]) + dot(other[2], c[0]));
            strain[5] = small ? strain[5] : 0.5f * (dot(other[1], c[2]) + dot(other[2], c[1]));
        }
        law_of(k, strain, r, stress);
        if (material.is_active) stress[0] = stress[0] + c[0] * at.values_of(material.activation.data);
        const lanes8 weight = at.weight() * at.value(passive.fill, passive.fill_stride);
        for (int j = 0; j < 3; ++j) stress[j] = chosen(valid, stress[j] * weight, nothing<lanes8>());
        p[0] = combined(n[0].x, stress[0], n[1].x, stress[1], n[2].x, stress[2]);
        p[1] = combined(n[0].y, stress[0], n[1].y, stress[1], n[2].y, stress[2]);
        p[2] = combined(n[0].z, stress[0], n[1].z, stress[1], n[2].z, stress[2]);
        return valid;
    }
};

template <class Material> COROT_INLINE ActiveOrthotropic<Material> orthotropic(const Material& material) { return {material}; }

}  // namespace corot
