// Forces of all leaves by themselves, for lanes that are not ``done``. In: x, leaf_axes; ``find_strain`` and
// ``stress`` of a law; ``join``, which adds to stresses of all lanes. Out: g and left_out.
#pragma clang loop unroll(disable)
for (int leaf = 0; leaf < 8; ++leaf) {
    material_of(leaf);
    triple a[3], f_[3], p[3];
    columns(x, nodes_of[leaf], a);
    const int* c = axes_of[leaf];
    const triple q[3] = {leaf_axes[c[0]], leaf_axes[c[1]], leaf_axes[c[2]]};
    lanes8 e[6];
    find_strain(a, q, e, f_);
    const masks8 sound = stress(f_, e, hand[leaf][0] * mirror, m * area, k * area, p);
    for (int j = 0; j < 3; ++j) p[j] = chosen(done, nothing, p[j]);
    join(leaf, a, q, p);
    left_out |= ~sound & ~done & (1 << leaf);
    add_leaf(g, nodes_of[leaf], p);
}
