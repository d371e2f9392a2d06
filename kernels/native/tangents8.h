// Products of the corotated law's stiffness with rotations found once, for eight elements; see corotated/tangent.py.
#pragma once

#include "elements8.h"

namespace corot {

// Writes gradients of the hat functions of the last three nodes, turned by the rotation of F and times the root of the
// volume: 9 x 8 floats of eight elements, side by side. Lists elements of which no rotation is found.
template <class Units, class Vectors, class List>
COROT_INLINE void turn_gradients(const Units& units, int block, int count, const Vectors& u, const Vectors& to, const List& missed) {
    const GeneralEight<Units> at(units, 8 * block, count);
    triple<lanes8> a[3], turn[3];
    gradient_of(at, u, a);
    const masks8 valid = rotation_of(deformation_of(a, at.frame), turn);
    const lanes8 size = root(at.volume), *b = at.b;
    float* place = &to.data[18 * block][0];
    for (int n = 0; n < 3; ++n) {
        const triple<lanes8> h = combined(b[3 * n], turn[0], b[3 * n + 1], turn[1], b[3 * n + 2], turn[2]) * size;
        store8(place + 24 * n, h.x);
        store8(place + 24 * n + 8, h.y);
        store8(place + 24 * n + 16, h.z);
    }
    at.list_invalid(valid, missed);
}

// Elements whose turned gradients are kept; forces are minus the product.
template <class Units> struct KeptEight : Eight<Units> {
    RestAxes<lanes8> frame;
    const float* kept;
    COROT_INLINE KeptEight(const Units& units, int block, int count, const float* kept)
        : Eight<Units>(units, 8 * block, count), kept(kept) {}
    COROT_INLINE lanes8 number(int k) const { return load8(kept + 8 * k); }
    COROT_INLINE lanes8 weight() const { return spread<lanes8>(1.0f); }
    COROT_INLINE void columns(const triple<lanes8>* x, triple<lanes8>* a) const {
        const triple<lanes8> d1 = x[1] - x[0], d2 = x[2] - x[0], d3 = x[3] - x[0];
        for (int j = 0; j < 3; ++j) a[j] = combined(number(j), d1, number(3 + j), d2, number(6 + j), d3);
    }
    COROT_INLINE void forces_of(const triple<lanes8>* p, triple<lanes8>* force) const {
        for (int n = 0; n < 3; ++n)
            force[n + 1] = combined(number(3 * n), p[0], number(3 * n + 1), p[1], number(3 * n + 2), p[2]);
        force[0] = -(force[1] + force[2] + force[3]);
    }
};

// y += R K R^T x.
template <class Units, class Material, class Vectors>
COROT_INLINE void add_kept_product(const Units& units, int block, int count, const Material& material, const Vectors& x,
        const Vectors& y) {
    const KeptEight<Units> at(units, block, count, &material.gradients.data[18 * block][0]);
    triple<lanes8> a[3], p[3], force[4];
    gradient_of(at, x, a);
    elastic(Linear{}, material.isotropic).stress(deformation_of(a, at.frame), at, p);
    at.forces_of(p, force);
    at.add_forces(force, y);
}

// y += K x with the exact derivative. Behind the gradients, strains e and matrices w (00, 11, 22, 01, 02, 12) are kept, both
// turned by the rotation.
template <class Units, class Material, class Vectors>
COROT_INLINE void add_exact_product(const Units& units, int block, int count, const Material& material, const Vectors& x,
        const Vectors& y) {
    const KeptEight<Units> at(units, block, count, &material.gradients.data[42 * block][0]);
    const auto& isotropic = material.isotropic;
    const lanes8 m = at.value(isotropic.mu, isotropic.stride), k = at.value(isotropic.lam, isotropic.stride);
    lanes8 e[6], w[6];
    for (int i = 0; i < 6; ++i) e[i] = at.number(9 + i), w[i] = at.number(15 + i);
    const triple<lanes8> strain[3] = {{e[0], e[3], e[4]}, {e[3], e[1], e[5]}, {e[4], e[5], e[2]}};
    const triple<lanes8> rows[3] = {{w[0], w[3], w[4]}, {w[3], w[1], w[5]}, {w[4], w[5], w[2]}};
    triple<lanes8> a[3], changed[3], p[3], force[4];
    gradient_of(at, x, a);
    const triple<lanes8> turns = {a[1].z - a[2].y, a[2].x - a[0].z, a[0].y - a[1].x};
    const triple<lanes8> t = {dot(rows[0], turns), dot(rows[1], turns), dot(rows[2], turns)};
    for (int j = 0; j < 3; ++j) changed[j] = cross(t, strain[j]);
    for (int j = 0; j < 3; ++j) a[j] = a[j] - changed[j];
    const lanes8 pressure = k * (a[0].x + a[1].y + a[2].z), held = k * (e[0] + e[1] + e[2]);
    const lanes8 s01 = m * (a[0].y + a[1].x), s02 = m * (a[0].z + a[2].x), s12 = m * (a[1].z + a[2].y);
    const lanes8 twice = 2.0f * m;
    p[0] = triple<lanes8>{twice * a[0].x + pressure, s01 + held * t.z, s02 - held * t.y} + changed[0] * twice;
    p[1] = triple<lanes8>{s01 - held * t.z, twice * a[1].y + pressure, s12 + held * t.x} + changed[1] * twice;
    p[2] = triple<lanes8>{s02 + held * t.y, s12 - held * t.x, twice * a[2].z + pressure} + changed[2] * twice;
    at.forces_of(p, force);
    at.add_forces(force, y);
}

}  // namespace corot
