// Ogden's law: ``stress``, see law_lanes.py. In: VOLUME_PART; ``neo_hookean``, ``eigen_of``; ``slope_of``, 2 G'.
const auto stress = [&](const triple* f, const lanes8* e, const lanes8& handedness, const lanes8& m,
        const lanes8& k, triple* p) {
    neo_hookean(f, e, handedness, VOLUME_PART * m, k, p);
    lanes8 strain[6], values[3], sigma[6];
    for (int i = 0; i < 6; ++i) strain[i] = 0.5f * e[i], sigma[i] = spread(0.0f);
    triple n[3], own[3];
    eigen_of(strain, values, n);
    for (int i = 0; i < 3; ++i) {
        const triple along = n[i] * (m * slope_of(values[i]));
        sigma[0] += along.x * n[i].x;
        sigma[1] += along.y * n[i].y;
        sigma[2] += along.z * n[i].z;
        sigma[3] += along.x * n[i].y;
        sigma[4] += along.x * n[i].z;
        sigma[5] += along.y * n[i].z;
    }
    times(f, sigma, own);
    for (int j = 0; j < 3; ++j) p[j] = p[j] + own[j];
    return every;
};
