// Forces of the dilatation that the eight leaves of a subtree share; see elements/dilatation.py. In: x, leaf_axes;
// ``theta_of``, ``slopes_of`` and ``pressure_of`` of a law. Out: g.
{
    lanes8 sum = spread(0.0f), weight = spread(0.0f);
    const auto leaf_of = [&](int leaf, triple* a, triple* q) {
        material_of(leaf);
        columns(x, nodes_of[leaf], a);
        const int* c = axes_of[leaf];
        for (int j = 0; j < 3; ++j) q[j] = leaf_axes[c[j]];
    };
    triple a[3], q[3], p[3];
#pragma clang loop unroll(disable)
    for (int leaf = 0; leaf < 8; ++leaf) {
        leaf_of(leaf, a, q);
        sum += k * theta_of(a, q, hand[leaf][0] * mirror);
        weight += k;
    }
    const masks8 weighted = weight != 0.0f;
    const lanes8 pressure = area * pressure_of(weighted ? sum / weight : spread(0.0f));
#pragma clang loop unroll(disable)
    for (int leaf = 0; leaf < 8; ++leaf) {
        leaf_of(leaf, a, q);
        slopes_of(a, q, hand[leaf][0] * mirror, p);
        for (int j = 0; j < 3; ++j) p[j] = p[j] * (k * pressure);
        add_leaf(g, nodes_of[leaf], p);
    }
}
