// Laws and mean dilatations of single elements, with their differentials: in float64 on the host (elements/float64.py), in
// float32 on every device (elements/constitutive.py, elements/forces.py, elements/dilatation.py).
#pragma once

#include "added.h"
#include "law_anisotropic.h"
#include "law_fibres.h"
#include "law_ogden.h"

namespace corot {

// Matrices as columns; such with a change as columns of dual numbers, and back.
template <class M, class S> COROT_INLINE void columns_of(const M& a, triple<S>* to) {
    for (int j = 0; j < 3; ++j) to[j] = {a.data[0][j], a.data[1][j], a.data[2][j]};
}

template <class M, class T> COROT_INLINE void columns_of(const M& a, const M& da, triple<dual_of<T>>* to) {
    for (int j = 0; j < 3; ++j)
        to[j] = {{a.data[0][j], da.data[0][j]}, {a.data[1][j], da.data[1][j]}, {a.data[2][j], da.data[2][j]}};
}

template <class M, class S> COROT_INLINE M matrix_of(const triple<S>* c) {
    return M(c[0].x, c[1].x, c[2].x, c[0].y, c[1].y, c[2].y, c[0].z, c[1].z, c[2].z);
}

template <class M, class T> COROT_INLINE void matrices_of(const triple<dual_of<T>>* columns, M& a, M& da) {
    for (int j = 0; j < 3; ++j) {
        const dual_of<T> column[3] = {columns[j].x, columns[j].y, columns[j].z};
        for (int i = 0; i < 3; ++i) a.data[i][j] = column[i].value, da.data[i][j] = column[i].slope;
    }
}

template <class M, class T> COROT_INLINE M slope_of(const triple<dual_of<T>>* columns) {
    M a, da;
    matrices_of(columns, a, da);
    return da;
}

// P of a displacement gradient A and its differential in a direction; whether the law holds there.
template <class Law, class M, class T>
COROT_INLINE bool stress_of(const Law& law, const M& a, const M& da, T mu, T lam, M& p, M& dp) {
    triple<dual_of<T>> columns[3], stress[3];
    columns_of(a, da, columns);
    const bool valid = law.stress(deformation_of(columns, RestAxes<T>()), mu, lam, stress);
    matrices_of(stress, p, dp);
    return valid;
}

// The same of a law without a differential.
template <class Law, class M, class T> COROT_INLINE bool stress_of(const Law& law, const M& a, T mu, T lam, M& p) {
    triple<T> columns[3], stress[3];
    columns_of(a, columns);
    const bool valid = law.stress(deformation_of(columns, RestAxes<T>()), mu, lam, stress);
    p = matrix_of<M>(stress);
    return valid;
}

// Whether the closed form of the corotated law may be trusted at a displacement gradient.
template <class M> COROT_INLINE bool has_stretch(const M& a) {
    triple<float> columns[3];
    columns_of(a, columns);
    const auto d = deformation_of(columns, RestAxes<float>());
    return stretch_of(d.e, dot(d.f[2], cross(d.f[0], d.f[1]))).valid;
}

template <class Law, class M, class T> COROT_INLINE T energy_of(const Law& law, const M& a, T mu, T lam) {
    triple<T> columns[3];
    columns_of(a, columns);
    return law.energy(deformation_of(columns, RestAxes<T>()), mu, lam);
}

// The proper frame Q of an element.
template <class M> COROT_INLINE Frame<float> frame_of(const M& q) {
    Frame<float> frame;
    columns_of(q, frame.q);
    frame.handedness = 1.0f;
    return frame;
}

// Of element t under a law with its material: P Q of G = (du/dX) Q, its differential in the direction dG, and the energy
// density.
template <class Law, class M, class Axes> COROT_INLINE M stress_at(const Law& law, int t, const M& g, const Axes& frame) {
    triple<float> columns[3], stress[3];
    columns_of(g, columns);
    law.stress(deformation_of(columns, frame), Single{t}, stress);
    return matrix_of<M>(stress);
}

template <class Law, class M> COROT_INLINE M differential_at(const Law& law, int t, const M& g, const M& q, const M& dg) {
    typedef dual_of<float> S;
    triple<S> columns[3], stress[3];
    columns_of(g, dg, columns);
    law.stress(deformation_of(columns, frame_of(q)), Single{t}, stress);
    return slope_of<M>(stress);
}

template <class Law, class M> COROT_INLINE float energy_at(const Law& law, int t, const M& g, const M& q) {
    triple<float> columns[3];
    columns_of(g, columns);
    return law.energy(deformation_of(columns, frame_of(q)), Single{t});
}

// Of an orthotropic material, from G M, its axes M and R M: P M, its differential in a direction dF M, the energy density, and
// the symmetric part of R^T P, both in the axes.
template <class M> COROT_INLINE Deformation<float, Frame<float>> in_axes(const M& g, const M& m) {
    triple<float> columns[3];
    columns_of(g, columns);
    return deformation_of(columns, frame_of(m));
}

template <class M> COROT_INLINE M orthotropic_stress(const Orthotropic& law, const M& g, const M& m, const M& r) {
    triple<float> turn[3], stress[3];
    columns_of(r, turn);
    law.stress(in_axes(g, m), turn, stress);
    return matrix_of<M>(stress);
}

template <class M> COROT_INLINE M orthotropic_differential(const Orthotropic& law, const M& g, const M& m, const M& r, const M& dg) {
    triple<dual_of<float>> columns[3], turned[3], stress[3];
    triple<float> turn[3];
    float e[6];
    columns_of(g, dg, columns);
    columns_of(r, turn);
    stretch_strain(in_axes(g, m), turn, e);
    const auto d = deformation_of(columns, frame_of(m));
    turn_of(d, e, turn, turned);
    law.stress(d, turned, stress);
    return slope_of<M>(stress);
}

// The strain S - I from the same.
template <class M> COROT_INLINE void strain_of(const M& g, const M& m, const M& r, float* e) {
    triple<float> turn[3];
    columns_of(r, turn);
    stretch_strain(in_axes(g, m), turn, e);
}

template <class M> COROT_INLINE float orthotropic_energy(const Orthotropic& law, const M& g, const M& m, const M& r) {
    float e[6];
    strain_of(g, m, r, e);
    return law.energy(e);
}

template <class M> COROT_INLINE M symmetric_of(const float* s) { return M(s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2]); }

template <class M> COROT_INLINE M orthotropic_cauchy(const Orthotropic& law, const M& g, const M& m, const M& r) {
    triple<float> a;
    float e[6], s[6];
    strain_of(g, m, r, e);
    law.stress(e, s, a);
    return symmetric_of<M>(s);
}

// The matrix by which axial(R^T dF) is the turning of R, of a strain.
template <class M> COROT_INLINE M turning_of(const M& strain) {
    const float e[6] = {strain.data[0][0], strain.data[1][1], strain.data[2][2], strain.data[0][1], strain.data[0][2], strain.data[1][2]};
    float w[6];
    turning_matrix(e, w);
    return symmetric_of<M>(w);
}

// The viscous stress P Q of F Q, R Q and dF/dt Q.
template <class M> COROT_INLINE M viscous_at(const M& f, const M& r, const M& rate, float m, float k) {
    triple<float> columns[3], turn[3], changes[3], stress[3];
    columns_of(f, columns);
    columns_of(r, turn);
    columns_of(rate, changes);
    viscous_stress(columns, turn, changes, m, k, stress);
    return matrix_of<M>(stress);
}

// Makes the state of element t a time later the known one of a ``PronyMaterial``.
template <class Material, class M> COROT_INLINE void relax_at(const Material& material, int t, const M& g, const M& q, float time) {
    triple<float> columns[3];
    columns_of(g, columns);
    prony(material).relax(deformation_of(columns, frame_of(q)), Single{t}, time);
}

// theta of a displacement gradient; d theta / dF, and its differential.
template <class Of, class M> COROT_INLINE float theta_of(const M& a) {
    triple<float> columns[3];
    columns_of(a, columns);
    return Of::theta(columns, RestAxes<float>());
}

template <class Of, class M> COROT_INLINE M slopes_of(const M& a) {
    triple<float> columns[3], slopes[3];
    columns_of(a, columns);
    Of::slopes(columns, RestAxes<float>(), slopes);
    return matrix_of<M>(slopes);
}

template <class Of, class M> COROT_INLINE M turning_of(const M& a, const M& da) {
    triple<dual_of<float>> columns[3], slopes[3];
    columns_of(a, da, columns);
    Of::slopes(columns, RestAxes<float>(), slopes);
    return slope_of<M>(slopes);
}

// theta, h' and h'' of an element; d theta / dF and its differential.
template <class Of, class M, class Vector>
COROT_INLINE void dilatation_of(const M& a, const M& da, Vector& numbers, M& slope, M& turning) {
    triple<dual> columns[3], slopes[3];
    columns_of(a, da, columns);
    const RestAxes<double> axes;
    const double theta = Of::theta(columns, axes).value;
    Of::slopes(columns, axes, slopes);
    matrices_of(slopes, slope, turning);
    const dual held = Of::holding(dual(theta, 1.0));
    numbers = Vector(theta, held.value, held.slope);
}

}  // namespace corot
