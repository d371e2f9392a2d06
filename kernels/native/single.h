// Laws and mean dilatations of single elements, with their differentials: in float64 on the host (elements/float64.py), in
// float32 on every device (elements/single.py).
#pragma once

#include "added.h"
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

template <class M, class S> COROT_INLINE void matrix_of(const triple<S>* columns, M& a) {
    for (int j = 0; j < 3; ++j) a.data[0][j] = columns[j].x, a.data[1][j] = columns[j].y, a.data[2][j] = columns[j].z;
}

template <class M, class T> COROT_INLINE void matrices_of(const triple<dual_of<T>>* columns, M& a, M& da) {
    for (int j = 0; j < 3; ++j) {
        const dual_of<T> column[3] = {columns[j].x, columns[j].y, columns[j].z};
        for (int i = 0; i < 3; ++i) a.data[i][j] = column[i].value, da.data[i][j] = column[i].slope;
    }
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
    matrix_of(stress, p);
    return valid;
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
    M p;
    matrix_of(stress, p);
    return p;
}

template <class Law, class M> COROT_INLINE M differential_at(const Law& law, int t, const M& g, const M& q, const M& dg) {
    typedef dual_of<float> S;
    triple<S> columns[3], stress[3];
    columns_of(g, dg, columns);
    law.stress(deformation_of(columns, frame_of(q)), Single{t}, stress);
    M p, dp;
    matrices_of(stress, p, dp);
    return dp;
}

template <class Law, class M> COROT_INLINE float energy_at(const Law& law, int t, const M& g, const M& q) {
    triple<float> columns[3];
    columns_of(g, columns);
    return law.energy(deformation_of(columns, frame_of(q)), Single{t});
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
    M p;
    matrix_of(slopes, p);
    return p;
}

template <class Of, class M> COROT_INLINE M turning_of(const M& a, const M& da) {
    triple<dual_of<float>> columns[3], slopes[3];
    columns_of(a, da, columns);
    Of::slopes(columns, RestAxes<float>(), slopes);
    M p, dp;
    matrices_of(slopes, p, dp);
    return dp;
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
