// St. Venant-Kirchhoff: ``stress``, see law_lanes.py. P = F (mu E + lambda / 2 tr E).
const auto stress = [&](const triple* f, const lanes8* e, const lanes8&, const lanes8& m, const lanes8& k,
        triple* p) {
    lanes8 sigma[6];
    const lanes8 pressure = 0.5f * k * (e[0] + e[1] + e[2]);
    for (int i = 0; i < 6; ++i) sigma[i] = m * e[i];
    for (int i = 0; i < 3; ++i) sigma[i] += pressure;
    times(f, sigma, p);
    return every;
};
