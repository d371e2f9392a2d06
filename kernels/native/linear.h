// Linear elasticity: ``stress`` of the small strain, see law_lanes.py.
const auto stress = [&](const triple* frame, const lanes8* e, const lanes8&, const lanes8& m, const lanes8& k,
        triple* p) {
    lanes8 sigma[6];
    const lanes8 pressure = k * (e[0] + e[1] + e[2]);
    for (int i = 0; i < 6; ++i) sigma[i] = 2.0f * m * e[i];
    for (int i = 0; i < 3; ++i) sigma[i] += pressure;
    times(frame, sigma, p);
    return every;
};
