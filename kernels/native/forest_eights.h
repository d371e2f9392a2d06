// Eight elements of a forest. In: side_by_side.h; units (``ForestElements``); FRAME_SHIFT, MIRROR_BIT, LEVEL_MASK. Out: where
// they are of type 1 and 2; edge lengths h; the ``frame``, whose last column has the sign of its ``handedness``;
// ``strain_of``.
const auto code = [&](int lane) { return units.code.data[element(lane)]; };
lanes8 axes[9];
gather_matrix([&](int lane) { return units.frames.data[code(lane) >> FRAME_SHIFT].data[0]; }, axes);
static const float signs[2] = {1.0f, -1.0f};
const lanes8 handedness = gather_one([&](int lane) { return signs + ((code(lane) >> MIRROR_BIT) & 1); });
const lanes8 h = gather_one([&](int lane) { return &units.size.data[(code(lane) & LEVEL_MASK) / 3]; });
masks8 type;
for (int lane = 0; lane < 8; ++lane) type[lane] = (code(lane) & LEVEL_MASK) % 3;
const masks8 is_type1 = type == 1, is_type2 = type == 2;
triple frame[3];
for (int j = 0; j < 3; ++j) frame[j] = triple{axes[j], axes[3 + j], axes[6 + j]};
frame[2] = frame[2] * handedness;
const auto strain_of = [&](const triple* a, lanes8* e, triple* f_) { find_strain(a, frame, e, f_); };
