// Ogden's law: powers of the principal stretches, as neo-Hookean plus a function of C = F^T F that vanishes at rest.
//
// With shares w_p of the shear modulus and exponents alpha_p, m_p = 2 w_p / alpha_p, L_i = ln c_i and c_i the squared principal
// stretches,
//     W / mu = sum_p m_p / alpha_p (sum_i exp(alpha_p L_i / 2) - 3) - sum_p m_p ln J + lambda / (2 mu) (ln J)^2.
// A part v_p of the logarithm of a term and of its stretches goes to neo-Hookean's energy, whose shear modulus is mu sum_p v_p
// then. What is left is mu sum_i G(c_i) with
//     G = sum_p m_p / alpha_p (c^(alpha_p / 2) - 1) - v_p / 2 (c - 1) - (m_p - v_p) / 2 ln c,  G(1) = G'(1) = 0.
// All resistance to turned-over elements is neo-Hookean's: G depends only on C, and has a bounded second derivative, because it
// goes on as a parabola where stretches are outside limits that follow from alpha_p. v_p is m_p where alpha_p is positive, w_p
// where it is negative, so that what is left never pulls a crushed element together.
#pragma once

#include "laws.h"

namespace corot {

// Three numbers, from the largest to the smallest, which stand for the eigenvalues of a symmetric tensor in polynomials:
// some 1e-3 of their differences away from these, and never nearer to one another than that. A polynomial that has a smooth
// function's values there has those of the function at the eigenvalues up to the product of all three distances.
template <class S> COROT_INLINE void eigenvalues_of(const S* e, S* values) {
    const S mean = (e[0] + e[1] + e[2]) * (1.0f / 3);
    const S d0 = e[0] - mean, d1 = e[1] - mean, d2 = e[2] - mean;
    const S squared = (d0 * d0 + d1 * d1 + d2 * d2 + 2.0f * (e[3] * e[3] + e[4] * e[4] + e[5] * e[5])) * (1.0f / 6);
    const S least = 1e-6f * mean * mean;
    const mask_of<S> spherical = inverted((squared > least) & (squared > 1e-30f));
    const S p = root(spherical ? least + 1e-30f : squared), scale = over(1.0f, p);
    const S n0 = d0 * scale, n1 = d1 * scale, n2 = d2 * scale, n01 = e[3] * scale, n02 = e[4] * scale, n12 = e[5] * scale;
    const S det = n0 * (n1 * n2 - n12 * n12) - n01 * (n01 * n2 - n12 * n02) + n02 * (n01 * n12 - n1 * n02);
    S r = spherical ? spread<S>(0.0f) : 0.5f * det;
    r = r > 0.9999997f ? spread<S>(0.9999997f) : r < -0.9999997f ? spread<S>(-0.9999997f) : r;
    // cos(acos(r) / 3) as a polynomial of cos(acos(r) / 2), to 1.2e-6.
    const auto third = [](const S& x) {
        return 0.50000121f + x * (0.5772581f + x * (-0.10994389f + x * (0.04779688f + x * (-0.01930408f + x * 0.00419271f))));
    };
    const S above = 2.0f * p * third(root(0.5f + 0.5f * r)), below = 2.0f * p * third(root(0.5f - 0.5f * r));
    values[0] = mean + above;
    values[1] = mean - (above - below);
    values[2] = mean - below;
}

// Eigenvalues, in no order, and eigenvectors of a symmetric tensor by Jacobi's method, to all digits of its size: after five
// sweeps nothing is left outside the diagonal in floats.
template <class T> COROT_INLINE void eigenvectors_of(const T* given, T* values, triple<T>* n) {
    T a[3][3] = {{given[0], given[3], given[4]}, {given[3], given[1], given[5]}, {given[4], given[5], given[2]}};
    n[0] = {1, 0, 0}, n[1] = {0, 1, 0}, n[2] = {0, 0, 1};
    for (int sweep = 0; sweep < (IS_FINE<T> ? 8 : 5) && (a[0][1] != 0 || a[0][2] != 0 || a[1][2] != 0); ++sweep) {
#if defined(__CUDACC__)
#pragma unroll
#endif
        for (int r = 2; r >= 0; --r) {
            const int p = r == 0 ? 1 : 0, q = 3 - p - r;
            if (a[p][q] == 0) continue;
            const T theta = over(T(0.5) * (a[q][q] - a[p][p]), a[p][q]);
            const T size = (theta < 0 ? -theta : theta) + root(theta * theta + 1);
            const T tangent = over(T(theta < 0 ? -1 : 1), size), cosine = over(T(1), root(tangent * tangent + 1));
            const T sine = tangent * cosine, rp = a[r][p], rq = a[r][q];
            a[p][p] -= tangent * a[p][q], a[q][q] += tangent * a[p][q];
            a[p][q] = a[q][p] = 0;
            a[r][p] = a[p][r] = cosine * rp - sine * rq, a[r][q] = a[q][r] = sine * rp + cosine * rq;
            const triple<T> np = n[p];
            n[p] = np * cosine - n[q] * sine, n[q] = np * sine + n[q] * cosine;
        }
    }
    for (int i = 0; i < 3; ++i) values[i] = a[i][i];
}

// For eigenvalues nearer to each other than this, over their size, the derivative at their mean is the quotient of differences.
template <class T> constexpr T NEAR = IS_FINE<T> ? 1e-5 : 3e-3;

// exp(x) - 1 - x to all its digits.
COROT_INLINE float power_rest(float x) {
    const float near = 0.5f * x * x
        * (1.0f + x * (1.0f / 3) * (1.0f + x * (1.0f / 4) * (1.0f + x * (1.0f / 5) * (1.0f + x * (1.0f / 6) * (1.0f + x * (1.0f / 7))))));
    return x > -0.5f && x < 0.5f ? near : power_excess(x) - x;
}

// (1 + x)^n - 1 of whole n >= 0, with the digits of x.
template <class S> COROT_INLINE S whole_power_excess(const S& x, int n) {
    S excess = spread<S>(0.0f);
    for (int i = 0; i < n; ++i) excess += x + excess * x;
    return excess;
}

// A term; ``low`` and ``high`` are eigenvalues of Green's strain between which it is the plain law, behind them their
// ln(1 + 2e).
struct OgdenTerm {
    float m, rest, power, low, high, log_low, log_high;
};

// P = P_neo-Hookean + mu F sum_i 2 G'(e_i) n_i n_i^T, of eigenvalues e_i and eigenvectors of Green's strain: by a polynomial
// without eigenvectors, which has no derivative, or, for dual numbers, with them.
template <int COUNT> struct Ogden {
    OgdenTerm terms[COUNT];
    float volume_part;  // of the shear modulus, which is neo-Hookean

    // Small whole powers are products.
    static COROT_INLINE bool is_whole(const OgdenTerm& term) {
        return term.power == static_cast<int>(term.power) && term.power > -6.0f && term.power < 6.0f;
    }
    COROT_INLINE bool needs_log() const {
        bool needs = false;
        for (int i = 0; i < COUNT; ++i) needs |= !is_whole(terms[i]);
        return needs;
    }

    // 2 G' at an eigenvalue.
    template <class S> COROT_INLINE S slope(const S& e) const {
        const S log = needs_log() ? log_of(e < -0.49999f ? spread<S>(-0.99998f) : 2.0f * e) : e;
        S sum = spread<S>(0.0f);
        for (int i = 0; i < COUNT; ++i) {
            const OgdenTerm& term = terms[i];
            const mask_of<S> low = e < term.low, high = e > term.high;
            const S inside = low ? spread<S>(term.low) : high ? spread<S>(term.high) : e;
            const S inverse = over(1.0f, 1.0f + 2.0f * inside);
            const S of_power = !is_whole(term)
                ? power_excess(term.power * (low ? spread<S>(term.log_low) : high ? spread<S>(term.log_high) : log))
                : term.power < 0.0f ? whole_power_excess(-2.0f * inside * inverse, -static_cast<int>(term.power))
                : whole_power_excess(2.0f * inside, static_cast<int>(term.power));
            sum += term.m * of_power;
            if (term.rest != 0.0f || any(low | high)) {
                const S curvature = (term.m * term.power * (1.0f + of_power) + term.rest * inverse) * inverse;
                sum += 2.0f * term.rest * inside * inverse + 2.0f * curvature * (e - inside);
            }
        }
        return sum;
    }

    template <class D, class N, class S = typename D::S>
    COROT_INLINE mask_of<S> stress(const D& d, const N& m, const N& k, triple<S>* p) const {
        NeoHookean::stress(d, N(volume_part * m), k, p);
        S e[6], values[3], sigma[6];
        for (int i = 0; i < 6; ++i) e[i] = 0.5f * d.e[i];
        eigenvalues_of(e, values);
        // Newton's polynomial: s0 + d0 (E - e0) + d01 (E - e0) (E - e1).
        const S s0 = slope(values[0]), s1 = slope(values[1]), s2 = slope(values[2]);
        const S first = over(s0 - s1, values[0] - values[1]), second = over(s1 - s2, values[1] - values[2]);
        const S curvature = over(m * (first - second), values[0] - values[2]);
        const S linear = m * first - curvature * (values[0] + values[1]);
        const S constant = m * (s0 - first * values[0]) + curvature * values[0] * values[1];
        sigma[0] = constant + linear * e[0] + curvature * (e[0] * e[0] + e[3] * e[3] + e[4] * e[4]);
        sigma[1] = constant + linear * e[1] + curvature * (e[3] * e[3] + e[1] * e[1] + e[5] * e[5]);
        sigma[2] = constant + linear * e[2] + curvature * (e[4] * e[4] + e[5] * e[5] + e[2] * e[2]);
        sigma[3] = linear * e[3] + curvature * (e[0] * e[3] + e[3] * e[1] + e[4] * e[5]);
        sigma[4] = linear * e[4] + curvature * (e[0] * e[4] + e[3] * e[5] + e[4] * e[2]);
        sigma[5] = linear * e[5] + curvature * (e[3] * e[4] + e[1] * e[5] + e[5] * e[2]);
        triple<S> own[3];
        times(d.f, sigma, own);
        for (int j = 0; j < 3; ++j) p[j] = p[j] + own[j];
        return every<S>();
    }

    template <class T, class N, class Axes>
    COROT_INLINE bool stress(const Deformation<dual_of<T>, Axes>& d, const N& m, const N& k, triple<dual_of<T>>* p) const {
        typedef dual_of<T> S;
        NeoHookean::stress(d, N(volume_part * m), k, p);
        T strain[6], change[6], turned[6], e[3], slopes[6] = {0, 0, 0, 0, 0, 0}, curvature[3], value[6];
        Frame<T> axes;
        for (int i = 0; i < 6; ++i) strain[i] = T(0.5) * d.e[i].value, change[i] = T(0.5) * d.e[i].slope;
        eigenvectors_of(strain, e, axes.q);
        for (int i = 0; i < 3; ++i) {
            const S of = slope(S(e[i], 1));
            slopes[i] = of.value, curvature[i] = of.slope;
        }
        const auto quotient = [&](int i, int j) {
            const T gap = e[j] - e[i], middle = T(0.5) * (e[i] + e[j]), size = middle < 0 ? -middle : middle;
            const bool apart = (gap < 0 ? -gap : gap) > NEAR<T> * (T(0.5) + size);
            return apart ? over(slopes[j] - slopes[i], apart ? gap : T(1)) : slope(S(middle, 1)).slope;
        };
        into_frame(axes, change, turned);
        for (int i = 0; i < 3; ++i) turned[i] *= curvature[i];
        turned[3] *= quotient(0, 1), turned[4] *= quotient(0, 2), turned[5] *= quotient(1, 2);
        out_of_frame(axes, slopes, value);
        out_of_frame(axes, turned, change);
        S sigma[6];
        for (int i = 0; i < 6; ++i) sigma[i] = S(m * value[i], m * change[i]);
        triple<S> own[3];
        times(d.f, sigma, own);
        for (int j = 0; j < 3; ++j) p[j] = p[j] + own[j];
        return true;
    }

    template <class D> COROT_INLINE float energy(const D& d, float m, float k) const {
        float strain[6], e[3], sum = 0.0f;
        triple<float> n[3];
        for (int i = 0; i < 6; ++i) strain[i] = 0.5f * d.e[i];
        eigenvectors_of(strain, e, n);
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < COUNT; ++j) {
                const OgdenTerm& term = terms[j];
                const float inside = e[i] < term.low ? term.low : e[i] > term.high ? term.high : e[i];
                const float log = inside <= term.low ? term.log_low : log_of(2.0f * inside), half = term.power + 1.0f;
                const float of_power = power_excess(term.power * log), inverse = over(1.0f, 1.0f + 2.0f * inside);
                const float slope = term.m * of_power + 2.0f * term.rest * inside * inverse;
                const float curvature = (term.m * term.power * (1.0f + of_power) + term.rest * inverse) * inverse;
                const float beyond = 2.0f * (e[i] - inside);
                sum += 0.5f * (over(term.m, half) * power_rest(half * log) - (term.m - term.rest) * power_rest(log)
                    + beyond * (slope + 0.5f * curvature * beyond));
            }
        }
        return NeoHookean::energy(d, volume_part * m, k) + m * sum;
    }
};

}  // namespace corot
