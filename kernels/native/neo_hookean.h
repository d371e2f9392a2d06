// Neo-Hookean: ``stress``, see law_lanes.py. In: CONTINUED_BELOW; ``invariants_of``, ``log_of``.
// P = cof F (mu E + lambda ln J) / J; below J0 = CONTINUED_BELOW mu F + U'(J) cof F, with U' continued linearly.
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
