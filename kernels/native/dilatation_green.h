// St. Venant-Kirchhoff: theta = tr E. In and out as in dilatation_small.h.
const auto theta_of = [&](const triple* a, const triple* q, const lanes8&) {
    const lanes8 linear = dot(a[0], q[0]) + dot(a[1], q[1]) + dot(a[2], q[2]);
    return linear + 0.5f * (dot(a[0], a[0]) + dot(a[1], a[1]) + dot(a[2], a[2]));
};
const auto slopes_of = [&](const triple* a, const triple* q, const lanes8&, triple* p) {
    for (int j = 0; j < 3; ++j) p[j] = q[j] + a[j];
};
const auto pressure_of = [&](const lanes8& theta) { return theta; };
const auto holding_of = [&](const lanes8&) { return spread(0.0f); };
