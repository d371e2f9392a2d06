    triple* a = gradients[eight];
    for (int j = 0; j < 3; ++j) a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
    *reinterpret_cast<lanes8*>(pressures + 8 * eight) = theta_of(a, axes, spread(1.0f));
}
const auto lambda_of = [&](int element) { return material.lam.data[isotropic.stride * element]; };
for (int group = first_group; group < last_group; ++group) {
    float sum = 0.0f, weight = 0.0f;
    for (int t = starts[group]; t < starts[group + 1]; ++t) {
        const float share = lambda_of(t) * units.volume.data[t];
        sum += share * pressures[t - begin];
        weight += share;
    }
    const lanes8 slope = pressure_of(spread(weight != 0.0f ? sum / weight : 0.0f));
    for (int t = starts[group]; t < starts[group + 1]; ++t) {
        const lanes8 own = holding_of(spread(pressures[t - begin]));
        pressures[t - begin] = lambda_of(t) * (slope[0] + own[0]);
    }
}
for (int first_element = begin, eight = 0; first_element < stop; first_element += 8, ++eight) {
    const int count = stop;
