// Eight elements. In: units (``GeneralElements``), block, count, u. Out: their number ``end``; ``element`` of a lane,
// the last one again where there are no more; displacements d1, d2, d3 of the last three nodes from the first; rest
// matrices b and volumes.
const int first_element = 8 * block, end = wp::min(8, count - first_element);
const auto element = [&](int lane) { return wp::min(first_element + lane, count - 1); };
const auto node = [&](int lane, int n) { return &u.data[units.nodes.data[element(lane)][n]][0]; };
lanes8 b[9], corner[4][4];
gather_matrix([&](int lane) { return units.rest_inverse.data[element(lane)].data[0]; }, b);
gather([&](int lane) { return node(lane, 0); }, corner[0]);
gather([&](int lane) { return node(lane, 1); }, corner[1]);
gather([&](int lane) { return node(lane, 2); }, corner[2]);
gather([&](int lane) { return node(lane, 3); }, corner[3]);
const triple d1 = get(corner[1], 0) - get(corner[0], 0), d2 = get(corner[2], 0) - get(corner[0], 0);
const triple d3 = get(corner[3], 0) - get(corner[0], 0);
// Values of elements, side by side.
const auto values_of = [&](const float* values) {
    return end == 8 ? *reinterpret_cast<const lanes8*>(values + first_element)
        : gather_one([&](int lane) { return values + element(lane); });
};
const lanes8 volume = values_of(units.volume.data);
