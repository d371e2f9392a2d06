// Ogden's law; see elements/ogden.py.
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
    const S p = root(spherical ? least + 1e-30f : squared), over = 1.0f / p;
    const S n0 = d0 * over, n1 = d1 * over, n2 = d2 * over, n01 = e[3] * over, n02 = e[4] * over, n12 = e[5] * over;
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

// P = P_neo-Hookean + mu F sum_i 2 G'(e_i) n_i n_i^T, of eigenvalues e_i and eigenvectors of Green's strain.
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
            const S inverse = 1.0f / (1.0f + 2.0f * inside);
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

    template <class D, class S = typename D::S>
    COROT_INLINE mask_of<S> stress(const D& d, const S& m, const S& k, triple<S>* p) const {
        NeoHookean::stress(d, volume_part * m, k, p);
        S e[6], values[3], sigma[6];
        for (int i = 0; i < 6; ++i) e[i] = 0.5f * d.e[i];
        eigenvalues_of(e, values);
        // Newton's polynomial: s0 + d0 (E - e0) + d01 (E - e0) (E - e1).
        const S s0 = slope(values[0]), s1 = slope(values[1]), s2 = slope(values[2]);
        const S first = (s0 - s1) / (values[0] - values[1]), second = (s1 - s2) / (values[1] - values[2]);
        const S curvature = m * (first - second) / (values[0] - values[2]);
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
};

}  // namespace corot
