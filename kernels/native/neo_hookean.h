// Neo-Hookean: ``stress``, see law_lanes.py. In: CONTINUED_BELOW; ``invariants_of``.
// P = cof F (mu E + lambda ln J) / J; below J0 = CONTINUED_BELOW mu F + U'(J) cof F, with U' continued linearly.

// ln(1 + j) of positive 1 + j: twice the artanh of j / (2 + j), of what powers of two leave within sqrt(2).
const auto log_of = [&](const lanes8& j) {
    const lanes8 whole = 1.0f + j;
    const masks8 bits = reinterpret_cast<const masks8&>(whole);
    const masks8 power = (bits - 0x3f3504f3) >> 23;
    const masks8 reduced = bits - (power << 23);
    const lanes8 rest = power == 0 ? j : reinterpret_cast<const lanes8&>(reduced) - 1.0f;
    const lanes8 z = rest / (2.0f + rest), zz = z * z;
    const lanes8 series = 1.0f + zz * (1.0f / 3 + zz * (0.2f + zz * (1.0f / 7 + zz * (1.0f / 9))));
    return 0.6931472f * __builtin_convertvector(power, lanes8) + 2.0f * z * series;
};
const auto stress = [&](const triple* f, const lanes8* e, const lanes8& handedness, const lanes8& m,
        const lanes8& k, triple* p) {
    const triple cofactor[3] = {cross(f[1], f[2]), cross(f[2], f[0]), cross(f[0], f[1])};
    const lanes8 j = invariants_of(e, handedness * dot(f[0], cofactor[0])).j;
    const masks8 crushed = j < CONTINUED_BELOW - 1.0f;
    const lanes8 safe = crushed ? spread(0.0f) : j;
    const lanes8 w = handedness / (1.0f + safe);
    const lanes8 pressure = w * k * log_of(safe), mw = m * w;
    lanes8 sigma[6];
    for (int i = 0; i < 6; ++i) sigma[i] = mw * e[i];
    for (int i = 0; i < 3; ++i) sigma[i] += pressure;
    times(cofactor, sigma, p);
    if (any(crushed)) {
        const float j0 = CONTINUED_BELOW, log0 = -0.6931472f;
        const lanes8 slope = handedness * ((k * log0 - m) / j0
            + (m + k * (1.0f - log0)) / (j0 * j0) * (j + (1.0f - j0)));
        for (int i = 0; i < 3; ++i) {
            p[i] = chosen(crushed, added(f[i] * m, slope, cofactor[i]), p[i]);
        }
    }
    return every;
};
