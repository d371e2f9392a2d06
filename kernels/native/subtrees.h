// Eight subtrees of a type. In: units (``Subtrees``), block, count, u, isotropic; VOLUME of a leaf over its edge cubed.
// Out: their number ``end``; ``place`` of a lane, the last one again where there are no more; displacements x of the
// ten nodes from the first, in edge lengths h of a leaf; the Maubach ``frame``, whose last column has the
// ``mirror``'s sign; forces g, none yet; a bit for each leaf that is left out, none yet.
const int first_subtree = 8 * block, end = wp::min(8, count - first_subtree);
const auto place = [&](int lane) { return wp::min(first_subtree + lane, count - 1); };
const auto code = [&](int lane) { return units.code.data[place(lane)]; };
lanes8 x[30], g[30], axes[9], origin[4], corner[4];
gather_matrix([&](int lane) { return units.frames.data[code(lane) >> FRAME_SHIFT].data[0]; }, axes);
triple frame[3];
for (int j = 0; j < 3; ++j) frame[j] = triple{axes[j], axes[3 + j], axes[6 + j]};
static const float signs[2] = {1.0f, -1.0f};
const lanes8 mirror = gather_one([&](int lane) { return signs + ((code(lane) >> MIRROR_BIT) & 1); });
const lanes8 h = 0.5f * gather_one([&](int lane) {
    return &units.size.data[(code(lane) & LEVEL_MASK) / 3];
});
const lanes8 inv_h = 1.0f / h;
frame[2] = frame[2] * mirror;
for (int k = 0; k < 10; ++k) {
    gather([&](int lane) { return &u.data[units.nodes.data[10 * place(lane) + k]][0]; }, k ? corner : origin);
    for (int axis = 0; axis < 3; ++axis) {
        x[3 * k + axis] = k ? (corner[axis] - origin[axis]) * inv_h : spread(0.0f);
        g[3 * k + axis] = spread(0.0f);
    }
}
// mu and lambda times the weight, of one leaf of each of the eight.
lanes8 m = spread(isotropic.mu.data[0]), k = spread(isotropic.lam.data[0]);
const auto material_of = [&](int leaf) {
    if (!isotropic.stride) return;
    const auto element = [&](int lane) { return units.first.data[place(lane)] + leaf; };
    m = gather_one([&](int lane) { return isotropic.mu.data + element(lane); });
    k = gather_one([&](int lane) { return isotropic.lam.data + element(lane); });
};
// Stresses of a leaf times this add up to forces.
const lanes8 area = VOLUME * h * h;
masks8 left_out = {};
