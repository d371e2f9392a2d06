// Columns a of the displacement gradient of eight elements, and where they are in the mesh. In: what elements.h has
// gathered; live, places. Out: a, axes, ``place`` of a lane, and how many are ``there``.
triple a[3];
for (int j = 0; j < 3; ++j) a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
const triple axes[3] = {{spread(1.0f), spread(0.0f), spread(0.0f)}, {spread(0.0f), spread(1.0f), spread(0.0f)},
    {spread(0.0f), spread(0.0f), spread(1.0f)}};
const int there = live.shape[0] ? wp::min(end, live.data[0] - first_element) : end;
const auto place = [&](int lane) { return places.shape[0] ? places.data[element(lane)] : element(lane); };
