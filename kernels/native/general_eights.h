// Eight general elements. In: rest_elements.h. Out: ``columns`` of (d1 d2 d3) B; ``forces_of`` columns p of a stress times
// ``weight``; the ``handedness`` of their frame, which is the identity; ``strain_of``.
const lanes8 handedness = spread(1.0f), weight = -volume;
const auto columns = [&](const triple* x, triple* a) {
    const triple d1 = x[1] - x[0], d2 = x[2] - x[0], d3 = x[3] - x[0];
    for (int j = 0; j < 3; ++j) a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
};
const auto forces_of = [&](const triple* p, triple* force) {
    for (int n = 0; n < 3; ++n) force[n + 1] = combined(b[3 * n], p[0], b[3 * n + 1], p[1], b[3 * n + 2], p[2]);
    force[0] = -(force[1] + force[2] + force[3]);
};
const auto strain_of = [&](const triple* a, lanes8* e, triple* f_) { find_strain_there(a, e, f_); };
