// Forces of what joins leaves alone. In: ``join``. Out: g.
#pragma clang loop unroll(disable)
for (int leaf = 0; leaf < 8; ++leaf) {
    triple a[3], p[3] = {nothing, nothing, nothing};
    columns(x, nodes_of[leaf], a);
    const int* c = axes_of[leaf];
    const triple q[3] = {leaf_axes[c[0]], leaf_axes[c[1]], leaf_axes[c[2]]};
    join(leaf, a, q, p);
    add_leaf(g, nodes_of[leaf], p);
}
