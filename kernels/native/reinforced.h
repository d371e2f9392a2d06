// The law of Holzapfel, Gasser and Ogden in eight elements; see fibres.py. In: gather_eights.h; ``to_frame``; ``stress`` of
// the matrix; ``power_excess``; material (``ReinforcedMaterial``); MOST, LEAST; u. Out: columns p of the stresses times the
// weight; ``sound``.
const auto& matrix = material.matrix;
const auto& fibres = material.fibres;
const auto modulus = [&](const wp::array_t<wp::float32>& of) {
    return weight * (matrix.stride ? values_of(of.data) : spread(of.data[0]));
};
triple a[3], f_[3], p[3];
lanes8 e[6], turn[9], numbers[4];
gathered(u, a);
strain_of(a, e, f_);
const masks8 sound = stress(f_, e, handedness, modulus(matrix.mu), modulus(matrix.lam), p);
gather_matrix([&](int lane) { return fibres.axes.data[fibres.axes_stride * element(lane)].data[0]; }, turn);
gather([&](int lane) { return &fibres.stiffness.data[fibres.stride * element(lane)][0]; }, numbers);
const triple along = to_frame({turn[0], turn[3], turn[6]}), beside = to_frame({turn[1], turn[4], turn[7]});
const lanes8 &k1 = numbers[0], &kappa = numbers[2], &angle = numbers[3];
const lanes8 held = weight * (fibres.fill_stride ? values_of(fibres.fill.data) : spread(fibres.fill.data[0]));
// phi' of a fibre strain.
const lanes8 rate = numbers[1] < LEAST ? spread(LEAST) : numbers[1];
const lanes8 most = __builtin_elementwise_sqrt(MOST / rate);
const auto slope_of = [&](const lanes8& e_) INLINED {
    const lanes8 inside = e_ < 0.0f ? spread(0.0f) : e_ > most ? most : e_;
    const lanes8 x = rate * inside * inside, grown = k1 * (1.0f + power_excess(x));
    const lanes8 beyond = e_ > inside ? e_ - inside : spread(0.0f);
    return grown * (inside + (e_ > 0.0f ? (1.0f + 2.0f * x) * beyond : spread(0.0f)));
};
// Adds w F (d d^T).
const auto pull = [&](const triple& d, const lanes8& w) INLINED {
    const triple pulled = combined(d.x, f_[0], d.y, f_[1], d.z, f_[2]) * w;
    p[0] = added(p[0], d.x, pulled);
    p[1] = added(p[1], d.y, pulled);
    p[2] = added(p[2], d.z, pulled);
};
const lanes8 others = 1.0f - 3.0f * kappa, spherical = kappa * (e[0] + e[1] + e[2]);
const auto add_family = [&](const triple& d, const lanes8& w) INLINED {
    const triple rows = {dot({e[0], e[3], e[4]}, d), dot({e[3], e[1], e[5]}, d), dot({e[4], e[5], e[2]}, d)};
    const lanes8 slope = 2.0f * w * slope_of(spherical + others * dot(d, rows));
    for (int j = 0; j < 3; ++j) p[j] = added(p[j], kappa * slope, f_[j]);
    pull(d, others * slope);
};
// Cosine and sine of angles from 0 to pi / 2, by series of what is less than pi / 4.
const masks8 steep = angle > 0.78539816f;
const lanes8 y = steep ? 1.57079633f - angle : angle, z = y * y;
const lanes8 small = y * (1.0f - z / 6.0f * (1.0f - z / 20.0f * (1.0f - z / 42.0f * (1.0f - z / 72.0f))));
const lanes8 large = 1.0f - z / 2.0f * (1.0f - z / 12.0f * (1.0f - z / 30.0f * (1.0f - z / 56.0f * (1.0f - z / 90.0f))));
const triple cosine = along * (steep ? small : large), sine = beside * (steep ? large : small);
add_family(cosine + sine, held);
const masks8 have_two = angle > 0.0f;
if (any(have_two)) add_family(cosine - sine, have_two ? held : spread(0.0f));
if (material.is_active) pull(along, held * values_of(material.activation.data));
