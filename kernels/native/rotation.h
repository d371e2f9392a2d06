// The rotation of F. In: columns f of F, E, the handedness of the frame. Out: columns r of R times the frame, and
// where they may be trusted.
const auto rotation_of = [&](const triple* f, const lanes8* e, const lanes8& handedness, triple* r) {
    const triple last = cross(f[0], f[1]);
    const stretch s = stretch_of(e, handedness * dot(f[2], last));
    const lanes8 w = 1.0f / s.q;
    lanes8 sigma[6];
    for (int i = 0; i < 6; ++i) sigma[i] = -2.0f * w * e[i];
    for (int i = 0; i < 3; ++i) sigma[i] += w * (10.0f + s.t * (6.0f + s.t) + s.of.a);
    times(f, sigma, r);
    const lanes8 v = 2.0f * (3.0f + s.t) * w * handedness;
    r[0] = added(r[0], v, cross(f[1], f[2]));
    r[1] = added(r[1], v, cross(f[2], f[0]));
    r[2] = added(r[2], v, last);
    return s.sound;
};
