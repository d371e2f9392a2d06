// The dilatation that the eight leaves of a subtree share; see elements/dilatation.py. In: x, leaf_axes; ``theta_of``,
// ``slopes_of``, ``pressure_of`` and ``holding_of`` of a law; its lambda in ``dilating``, where isotropic has none. Out: ``join``,
// which adds a leaf's part to the columns p of its stress, of columns a of the displacement gradient in its frame q.
const auto lambda_of = [&](int leaf) {
    if (!isotropic.stride) return spread(dilating.data[0]);
    return gather_one([&](int lane) { return dilating.data + units.first.data[place(lane)] + leaf; });
};
lanes8 shared_pressure;
{
    lanes8 sum = spread(0.0f), weight = spread(0.0f);
    triple a[3];
#pragma clang loop unroll(disable)
    for (int leaf = 0; leaf < 8; ++leaf) {
        const lanes8 share = lambda_of(leaf);
        columns(x, nodes_of[leaf], a);
        const int* c = axes_of[leaf];
        const triple q[3] = {leaf_axes[c[0]], leaf_axes[c[1]], leaf_axes[c[2]]};
        sum += share * theta_of(a, q, hand[leaf][0] * mirror);
        weight += share;
    }
    const masks8 weighted = weight != 0.0f;
    shared_pressure = pressure_of(weighted ? sum / weight : spread(0.0f));
}
const auto join = [&](int leaf, const triple* a, const triple* q, triple* p) {
    triple slopes[3];
    const lanes8 handedness = hand[leaf][0] * mirror;
    slopes_of(a, q, handedness, slopes);
    const lanes8 own = holding_of(theta_of(a, q, handedness));
    const lanes8 w = area * lambda_of(leaf) * (shared_pressure + own);
    for (int j = 0; j < 3; ++j) p[j] = added(p[j], w, slopes[j]);
};
