// Linear elasticity: theta = tr e. In: columns a of the displacement gradient and q of the frame. Out: theta, the
// columns p of d theta / dF, w' of a mean theta, and h' of an element's own.
const auto theta_of = [&](const triple* a, const triple* q, const lanes8&) {
    return dot(a[0], q[0]) + dot(a[1], q[1]) + dot(a[2], q[2]);
};
const auto slopes_of = [&](const triple*, const triple* q, const lanes8&, triple* p) {
    for (int j = 0; j < 3; ++j) p[j] = q[j];
};
const auto pressure_of = [&](const lanes8& theta) { return theta; };
const auto holding_of = [&](const lanes8&) { return spread(0.0f); };
