// Eight elements where they are. In: rest_elements.h; u. Out: displacements d1, d2, d3 of the last three nodes from the
// first.
const auto node = [&](int lane, int n) { return &u.data[units.nodes.data[element(lane)][n]][0]; };
lanes8 corner[4][4];
gather([&](int lane) { return node(lane, 0); }, corner[0]);
gather([&](int lane) { return node(lane, 1); }, corner[1]);
gather([&](int lane) { return node(lane, 2); }, corner[2]);
gather([&](int lane) { return node(lane, 3); }, corner[3]);
const triple d1 = get(corner[1], 0) - get(corner[0], 0), d2 = get(corner[2], 0) - get(corner[0], 0);
const triple d3 = get(corner[3], 0) - get(corner[0], 0);
