// What polynomials of the stretch S are made of. In: E and det F; INDEFINITE. Out: t = tr S - 3, q (see
// law_lanes.py); ``sound`` where q and the root t are good.
struct stretch { invariants of; lanes8 t, q; masks8 sound; };
const auto stretch_of = [&](const lanes8* e, const lanes8& det) {
    stretch s;
    s.of = invariants_of(e, det);
    const lanes8 &a = s.of.a, &b = s.of.b, &c = s.of.c, &j = s.of.j;
    const lanes8 c0 = a * a - 20.0f * a - 24.0f * j - 4.0f * b, c1 = 64.0f - 12.0f * a - 8.0f * j;
    const lanes8 c2 = 48.0f - 2.0f * a;
    // The series of tr sqrt(I + E), or from above, where the iteration cannot miss the root.
    lanes8 t = 0.5f * a;
    const lanes8 &p2 = s.of.squared, p3 = a * p2 - b * a + 3.0f * c, p4 = a * p3 - b * p2 + c * a;
    const lanes8 p5 = a * p4 - b * p3 + c * p2;
    t = s.of.small ? t - 0.125f * p2 + 0.0625f * p3 - 0.0390625f * p4 + 0.02734375f * p5 : t;
    masks8 open = t == t;
    for (int iteration = 0; iteration < 24; ++iteration) {
        const lanes8 value = (((t + 12.0f) * t + c2) * t + c1) * t + c0;
        const lanes8 slope = ((4.0f * t + 36.0f) * t + 2.0f * c2) * t + c1;
        const lanes8 step = value / slope;
        t = open ? t - step : t;
        open &= step * step > 1e-8f * (t + 3.0f) * (t + 3.0f);
        if (!any(open)) break;
    }
    s.t = t;
    s.q = 16.0f + t * (24.0f + t * (9.0f + t)) - a * (3.0f + t) - 2.0f * j;
    s.sound = ~open & (s.q > INDEFINITE) & (a < 1000.0f);
    return s;
};
