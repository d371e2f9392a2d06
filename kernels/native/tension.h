// The stiffness of tension of the corotated law, see corotated/tension.py: of one element, and of eight.
#pragma once

#include "elements8.h"

namespace corot {

template <class S> COROT_INLINE S larger(const S& a, const S& b) { return a > b ? a : b; }
template <class S> COROT_INLINE S smaller(const S& a, const S& b) { return a < b ? a : b; }

// A divided difference; zero between equal places.
template <class S> COROT_INLINE S slope_between(const S& y0, const S& y1, const S& x0, const S& x1) {
    const S gap = x1 - x0, zero = spread<S>(0.0f);
    const mask_of<S> apart = (gap > 1e-5f) | (gap < -1e-5f);
    return apart ? over(y1 - y0, apart ? gap : spread<S>(1.0f)) : zero;
}

// The eigenvalues of a symmetric tensor by the cosine c of a third of an angle (Smith 1961): c is a smooth function of the
// root of (1 + cos) / 2 of the whole angle, here to 1.2e-6.
template <class S> COROT_INLINE void eigenvalues(const S* e, S* found) {
    const S third = (e[0] + e[1] + e[2]) * (1.0f / 3), x = e[0] - third, y = e[1] - third, z = e[2] - third;
    const S radius = root((x * x + y * y + z * z + 2.0f * (e[3] * e[3] + e[4] * e[4] + e[5] * e[5])) * (1.0f / 6));
    const S det = x * (y * z - e[5] * e[5]) - e[3] * (e[3] * z - e[5] * e[4]) + e[4] * (e[3] * e[5] - y * e[4]);
    const S inverse = over(spread<S>(1.0f), larger(radius, spread<S>(1e-10f)));
    const S cosine = 0.5f * (det * inverse) * (inverse * inverse), zero = spread<S>(0.0f), one = spread<S>(1.0f);
    const S s = root(smaller(larger(0.5f + 0.5f * cosine, zero), one));
    const S c = 0.5f + s * (0.5772581f + s * (-0.10994389f + s * (0.04779688f + s * (-0.01930408f + s * 0.00419271f))));
    const S sine = root(larger(1.0f - c * c, zero));
    found[0] = third + 2.0f * radius * c;
    found[1] = third - radius * (c - 1.7320508f * sine);
    found[2] = third - radius * (c + 1.7320508f * sine);
}

// Theta without what the other part of the pressure p has of it, the p that counts, and the largest eigenvalue of the whole.
template <class S> struct Twist {
    S theta[6], pulling, largest;
};

// The least sum of two principal stretches, so that crushed elements have no boundless stiffness; and the largest pressure that
// counts, times the longest stretch, over mu.
constexpr float LEAST_STRETCHES = 0.5f, MOST_PRESSURE = 1.9f;

// Of the strain S - I: Theta is a function of it, which Newton's polynomial through the eigenvalues gives.
template <class S> COROT_INLINE Twist<S> twist_of(const S* strain, const S& mu, const S& lam, const S& pressure) {
    Twist<S> t;
    S e[3], twist[3];
    const S zero = spread<S>(0.0f), trace = strain[0] + strain[1] + strain[2];
    eigenvalues(strain, e);
    const S longest = larger(1.0f + larger(e[0], larger(e[1], e[2])), spread<S>(LEAST_STRETCHES));
    const S p = smaller(pressure, over(MOST_PRESSURE * mu, longest));
    t.pulling = larger(p, zero), t.largest = zero;
    for (int k = 0; k < 3; ++k) {
        const S sum = trace - e[k], stretches = larger(2.0f + sum, spread<S>(LEAST_STRETCHES));
        const S whole = larger(over(2.0f * (mu * sum + lam * trace), stretches) + p * (1.0f + e[k]), zero);
        t.largest = larger(t.largest, whole);
        twist[k] = whole - t.pulling * (1.0f + e[k]);
    }
    const S slope = slope_between(twist[0], twist[1], e[0], e[1]);
    const S bend = slope_between(slope, slope_between(twist[0], twist[2], e[0], e[2]), e[1], e[2]);
    const S a = strain[0], b = strain[1], c = strain[2], d = strain[3], f = strain[4], g = strain[5];
    const S square[6] = {a * a + d * d + f * f, d * d + b * b + g * g, f * f + g * g + c * c, a * d + d * b + f * g,
        a * f + d * g + f * c, d * f + b * g + g * c};
    const S linear = slope - bend * (e[0] + e[1]);
    for (int i = 0; i < 6; ++i) t.theta[i] = linear * strain[i] + bend * square[i];
    for (int i = 0; i < 3; ++i) t.theta[i] += twist[0] - e[0] * (slope - bend * e[1]);
    return t;
}

// The same of one element: Theta, then the pressure and the largest eigenvalue in a fourth row.
template <class M43, class M> COROT_INLINE M43 twist_at(const M& strain, float mu, float lam, float pressure) {
    const float e[6] = {strain.data[0][0], strain.data[1][1], strain.data[2][2], strain.data[0][1], strain.data[0][2],
        strain.data[1][2]};
    const Twist<float> t = twist_of(e, mu, lam, pressure);
    const int places[9] = {0, 3, 4, 3, 1, 5, 4, 5, 2};
    M43 found;
    for (int i = 0; i < 9; ++i) found.data[i / 3][i % 3] = t.theta[places[i]];
    found.data[3][0] = t.pulling, found.data[3][1] = t.largest, found.data[3][2] = 0.0f;
    return found;
}

#if !defined(__CUDACC__)
// The largest square of a hat function's gradient.
template <class Units> COROT_INLINE lanes8 steepest(const ForestEight<Units>& at, float of_shapes) { return of_shapes / (at.h * at.h); }

template <class Units> COROT_INLINE lanes8 steepest(const GeneralEight<Units>& at, float) {
    lanes8 found = spread<lanes8>(0.0f);
    triple<lanes8> sum = nothing<lanes8>();
    for (int n = 0; n < 3; ++n) {
        const triple<lanes8> row = {at.b[3 * n], at.b[3 * n + 1], at.b[3 * n + 2]};
        sum = sum + row;
        found = larger(found, dot(row, row));
    }
    return larger(found, dot(sum, sum));
}

template <class Units> COROT_INLINE lanes8 volume_of(const ForestEight<Units>& at) {
    const lanes8 share = at.is_1 ? spread<lanes8>(VOLUME[1]) : at.is_2 ? spread<lanes8>(VOLUME[2]) : spread<lanes8>(VOLUME[0]);
    return share * at.h * at.h * at.h;
}

template <class Units> COROT_INLINE lanes8 volume_of(const GeneralEight<Units>& at) { return at.volume; }

// Writes symmetric tensors in world axes, of columns r of the rotation and a tensor in the frame, for lanes that are chosen.
template <class At, class Matrices>
COROT_INLINE void write_turned(const At& at, const masks8& which, const triple<lanes8>* r, const lanes8* s, const Matrices& to) {
    triple<lanes8> v[3];
    times(r, s, v);
    const lanes8 w[6] = {
        v[0].x * r[0].x + v[1].x * r[1].x + v[2].x * r[2].x, v[0].y * r[0].y + v[1].y * r[1].y + v[2].y * r[2].y,
        v[0].z * r[0].z + v[1].z * r[1].z + v[2].z * r[2].z, v[0].x * r[0].y + v[1].x * r[1].y + v[2].x * r[2].y,
        v[0].x * r[0].z + v[1].x * r[1].z + v[2].x * r[2].z, v[0].y * r[0].z + v[1].y * r[1].z + v[2].y * r[2].z};
    const int places[9] = {0, 3, 4, 3, 1, 5, 4, 5, 2};
    for (int lane = 0; lane < at.end; ++lane)
        if (which[lane])
            for (int i = 0; i < 9; ++i) to.data[at.place(lane)].data[i / 3][i % 3] = w[places[i]][lane];
}

// Finds which of eight elements count, and their rotations, Theta and p S.
template <class At, class Material, class Vectors, class Numbers, class Flags, class Matrices>
COROT_INLINE void find_taut(const At& at, float meeting, float of_shapes, const Material& isotropic, const Material& dilating,
        const Vectors& shared, const Numbers& mass, const Numbers& scales, const Vectors& u, const Flags& taut,
        const Matrices& turns, const Matrices& twists, const Matrices& swells) {
    const lanes8 zero = spread<lanes8>(0.0f);
    triple<lanes8> a[3], r[3];
    gradient_of(at, u, a);
    const auto d = deformation_of(a, at.frame);
    const lanes8 mu = at.value(isotropic.mu, isotropic.stride), lam = at.value(isotropic.lam, isotropic.stride);
    lanes8 pressure = zero;
    if (shared.shape[0])
        pressure = at.value(dilating.lam, dilating.stride)
            * gather_one([&](int lane) { return &shared.data[at.place(lane)][1]; });
    // Green's strains are no smaller than the others where these are positive.
    const lanes8 size = 0.5f * root(d.e[0] * d.e[0] + d.e[1] * d.e[1] + d.e[2] * d.e[2]
        + 2.0f * (d.e[3] * d.e[3] + d.e[4] * d.e[4] + d.e[5] * d.e[5]));
    const lanes8 bound = 1.42f * mu * size + lam * larger(d.e[0] + d.e[1] + d.e[2], zero) + larger(pressure, zero) * (1.0f + size);
    lanes8 least = spread<lanes8>(1e38f);
    for (int n = 0; n < 4; ++n)
        least = smaller(least, gather_one([&](int lane) { return &mass.data[at.units.nodes.data[at.place(lane)][n]]; }));
    const lanes8 stiffness = (scales.data[2] * meeting) * volume_of(at) * steepest(at, of_shapes);
    const lanes8 inertia = scales.data[0] * least;
    masks8 counts = stiffness * bound > inertia;
    if (any(counts)) {
        const masks8 valid = rotation_of(d, r);
        lanes8 strain[6];
        for (int j = 0; j < 3; ++j) strain[j] = dot(r[j], d.f[j]) - 1.0f;
        strain[3] = 0.5f * (dot(r[0], d.f[1]) + dot(r[1], d.f[0]));
        strain[4] = 0.5f * (dot(r[0], d.f[2]) + dot(r[2], d.f[0]));
        strain[5] = 0.5f * (dot(r[1], d.f[2]) + dot(r[2], d.f[1]));
        const Twist<lanes8> t = twist_of(strain, mu, lam, pressure);
        counts &= valid & (stiffness * t.largest > inertia);
        if (any(counts)) {
            write_turned(at, counts, r, t.theta, twists);
            if (swells.shape[0]) {
                for (int j = 0; j < 3; ++j) strain[j] += 1.0f;
                for (int i = 0; i < 6; ++i) strain[i] *= t.pulling;
                write_turned(at, counts, r, strain, swells);
            }
            r[2] = r[2] * handedness_of(at.frame);
            for (int lane = 0; lane < at.end; ++lane)
                if (counts[lane])
                    for (int j = 0; j < 3; ++j) {
                        auto& turn = turns.data[at.place(lane)];
                        turn.data[0][j] = r[j].x[lane], turn.data[1][j] = r[j].y[lane], turn.data[2][j] = r[j].z[lane];
                    }
        }
    }
    for (int lane = 0; lane < at.end; ++lane) taut.data[at.place(lane)] = counts[lane] != 0;
}

// y += K p of tension, of eight elements.
template <class At, class Vectors, class Flags, class Matrices>
COROT_INLINE void add_taut_product(const At& at, const Flags& taut, const Matrices& turns, const Matrices& twists,
        const Matrices& swells, const Vectors& p, const Vectors& y) {
    const lanes8 zero = spread<lanes8>(0.0f);
    masks8 counts;
    for (int lane = 0; lane < 8; ++lane) counts[lane] = taut.data[at.place(lane)] ? -1 : 0;
    triple<lanes8> a[3], r[3], stress[3], force[4];
    lanes8 m[9];
    gradient_of(at, p, a);
    gather_matrix([&](int lane) { return turns.data[at.place(lane)].data[0]; }, m);
    for (int j = 0; j < 3; ++j) r[j] = {m[j], m[3 + j], m[6 + j]};
    r[2] = r[2] * handedness_of(at.frame);
    const lanes8 weight = counts ? volume_of(at) : zero;
    gather_matrix([&](int lane) { return twists.data[at.place(lane)].data[0]; }, m);
    const triple<lanes8> axial = cross(r[0], a[0]) + cross(r[1], a[1]) + cross(r[2], a[2]);
    const triple<lanes8> rows[3] = {{m[0], m[1], m[2]}, {m[3], m[4], m[5]}, {m[6], m[7], m[8]}};
    const triple<lanes8> moment = triple<lanes8>{dot(rows[0], axial), dot(rows[1], axial), dot(rows[2], axial)} * 0.5f;
    for (int j = 0; j < 3; ++j) stress[j] = cross(moment, r[j]);
    if (swells.shape[0]) {
        // The change of the cofactor of p S in the direction B = dF R^T, times R.
        gather_matrix([&](int lane) { return swells.data[at.place(lane)].data[0]; }, m);
        const triple<lanes8> s[3] = {{m[0], m[3], m[6]}, {m[1], m[4], m[7]}, {m[2], m[5], m[8]}};
        const triple<lanes8> b[3] = {combined(r[0].x, a[0], r[1].x, a[1], r[2].x, a[2]),
            combined(r[0].y, a[0], r[1].y, a[1], r[2].y, a[2]), combined(r[0].z, a[0], r[1].z, a[1], r[2].z, a[2])};
        const triple<lanes8> c[3] = {cross(b[1], s[2]) + cross(s[1], b[2]), cross(b[2], s[0]) + cross(s[2], b[0]),
            cross(b[0], s[1]) + cross(s[0], b[1])};
        for (int j = 0; j < 3; ++j) stress[j] = stress[j] + combined(r[j].x, c[0], r[j].y, c[1], r[j].z, c[2]);
    }
    for (int j = 0; j < 3; ++j) stress[j] = chosen(counts, stress[j] * weight, nothing<lanes8>());
    at.forces_of(stress, force);
    at.add_forces(force, y);
}

template <template <class> class At, class Units, class Flags, class... Rest>
COROT_INLINE void add_taut_product(const Units& units, int block, int count, const Flags& taut, const Rest&... rest) {
    const int first = 8 * block, end = least_of(first + 8, count);
    for (int t = first; t < end; ++t)
        if (taut.data[t]) return add_taut_product(At<Units>(units, first, count), taut, rest...);
}

template <template <class> class At, class Units, class... Rest>
COROT_INLINE void find_taut(const Units& units, int block, int count, const Rest&... rest) {
    find_taut(At<Units>(units, 8 * block, count), rest...);
}
#endif

}  // namespace corot
