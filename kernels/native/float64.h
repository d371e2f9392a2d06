// Laws and shared dilatations in float64 with their differentials, one element at a time; see elements/float64.py.
#pragma once

#include "law_ogden.h"
#include "dilatation.h"

namespace corot {

// The columns of a matrix that changes, and such columns as a matrix and its change.
template <class M> COROT_INLINE void columns_of(const M& a, const M& da, triple<dual>* to) {
    for (int j = 0; j < 3; ++j)
        to[j] = {{a.data[0][j], da.data[0][j]}, {a.data[1][j], da.data[1][j]}, {a.data[2][j], da.data[2][j]}};
}

template <class M> COROT_INLINE void matrices_of(const triple<dual>* columns, M& a, M& da) {
    for (int j = 0; j < 3; ++j) {
        const dual column[3] = {columns[j].x, columns[j].y, columns[j].z};
        for (int i = 0; i < 3; ++i) a.data[i][j] = column[i].value, da.data[i][j] = column[i].slope;
    }
}

// P of a displacement gradient A and its differential in a direction; whether the law holds there.
template <class Law, class M>
COROT_INLINE bool stress_of(const Law& law, const M& a, const M& da, double mu, double lam, M& p, M& dp) {
    triple<dual> columns[3], stress[3];
    columns_of(a, da, columns);
    const bool valid = law.stress(deformation_of(columns, RestAxes<dual>()), dual(mu), dual(lam), stress);
    matrices_of(stress, p, dp);
    return valid;
}

// The same of a law without a differential.
template <class Law, class M> COROT_INLINE bool stress_of(const Law& law, const M& a, double mu, double lam, M& p) {
    triple<double> columns[3], stress[3];
    for (int j = 0; j < 3; ++j) columns[j] = {a.data[0][j], a.data[1][j], a.data[2][j]};
    const bool valid = law.stress(deformation_of(columns, RestAxes<double>()), mu, lam, stress);
    for (int j = 0; j < 3; ++j) p.data[0][j] = stress[j].x, p.data[1][j] = stress[j].y, p.data[2][j] = stress[j].z;
    return valid;
}

// theta, h' and h'' of an element; d theta / dF and its differential.
template <class Of, class M, class Vector>
COROT_INLINE void dilatation_of(const M& a, const M& da, Vector& numbers, M& slope, M& turning) {
    triple<dual> columns[3], slopes[3];
    columns_of(a, da, columns);
    const RestAxes<dual> axes;
    const double theta = Of::theta(columns, axes).value;
    Of::slopes(columns, axes, slopes);
    matrices_of(slopes, slope, turning);
    const dual held = Of::holding(dual(theta, 1.0));
    numbers = Vector(theta, held.value, held.slope);
}

}  // namespace corot
