// The corotated law: ``stress``, see law_lanes.py. In: INDEFINITE; ``stretch_of``. P is zero where it is not trusted.
const auto stress = [&](const triple* f, const lanes8* e, const lanes8& handedness, const lanes8& m,
        const lanes8& k, triple* p) {
    const triple last = cross(f[0], f[1]);
    const stretch s = stretch_of(e, handedness * dot(f[2], last));
    const lanes8 &a = s.of.a, &j = s.of.j, &t = s.t;
    const lanes8 kt = k * t;
    const lanes8 w = (2.0f * m - kt) / s.q;
    const lanes8 y = (2.0f * t - 6.0f * j) / (1.0f + j);
    lanes8 s0 = kt + w * (t * (18.0f + t * (8.0f + t)) - a * (10.0f + t) - 2.0f * j - y * (1.0f + a));
    lanes8 s1 = w * (8.0f + y), s2 = -w * (6.0f + y);
    const bool mixed = any(~s.of.small);
    if (mixed) {
        s0 = s.of.small ? s0 : 2.0f * m - w * (10.0f + t * (6.0f + t) + a);
        s1 = s.of.small ? s1 : 2.0f * w;
        s2 = s.of.small ? s2 : spread(0.0f);
    }
    lanes8 sigma[6];
    for (int i = 0; i < 6; ++i) sigma[i] = s1 * e[i] + s2 * s.of.adjugate[i];
    for (int i = 0; i < 3; ++i) sigma[i] += s0;
    times(f, sigma, p);
    if (mixed) {
        const lanes8 v = s.of.small ? spread(0.0f) : -2.0f * (3.0f + t) * w * handedness;
        p[0] = added(p[0], v, cross(f[1], f[2]));
        p[1] = added(p[1], v, cross(f[2], f[0]));
        p[2] = added(p[2], v, last);
        for (int i = 0; i < 3; ++i) p[i] = chosen(s.sound, p[i], nothing);
    }
    return s.sound;
};
