// Functions for forces of all leaves with one rotation; ``turn`` are the columns of R times the frame. In: what
// subtrees.h has gathered; ``columns``, ``add_leaf`` and ``multiply`` of the type.

// Columns f of F of the subtree as one element, times the frame, and E there.
const auto root_strain = [&](lanes8* e, triple* f) {
    static const int corners[4] = {0, 1, 2, 3};
    triple a[3];
    columns(x, corners, a);
    // The subtree's edge is two of a leaf's.
    for (int j = 0; j < 3; ++j) a[j] = a[j] * 0.5f;
    find_strain(a, frame, e, f);
};

// Displacements y in the subtree's Maubach frame, where the leaves are linear elements. The columns ``turned`` of R -
// I in this frame are, for a rotation by less than a right angle, made of its axial vector, which has its digits
// however small it is, by Rodrigues' formula; and ``turn`` is made the same R's.
const auto turn_back = [&](triple* turn, lanes8* y) {
    triple turned[3];
    lanes8 r[3][3];
    for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) r[i][j] = dot(frame[i], turn[j]);
    const lanes8 x_ = 0.5f * (r[2][1] - r[1][2]), y_ = 0.5f * (r[0][2] - r[2][0]), z_ = 0.5f * (r[1][0] - r[0][1]);
    const lanes8 cosine = 0.5f * (r[0][0] + r[1][1] + r[2][2] - 1.0f), w = 1.0f / (1.0f + cosine);
    const lanes8 xx_ = w * x_ * x_, yy_ = w * y_ * y_, zz_ = w * z_ * z_;
    const lanes8 xy_ = w * x_ * y_, xz_ = w * x_ * z_, yz_ = w * y_ * z_;
    const masks8 acute = cosine > 0.0f;
    turned[0].x = acute ? -yy_ - zz_ : r[0][0] - 1.0f;
    turned[0].y = acute ? xy_ + z_ : r[1][0];
    turned[0].z = acute ? xz_ - y_ : r[2][0];
    turned[1].x = acute ? xy_ - z_ : r[0][1];
    turned[1].y = acute ? -xx_ - zz_ : r[1][1] - 1.0f;
    turned[1].z = acute ? yz_ + x_ : r[2][1];
    turned[2].x = acute ? xz_ + y_ : r[0][2];
    turned[2].y = acute ? yz_ - x_ : r[1][2];
    turned[2].z = acute ? -xx_ - yy_ : r[2][2] - 1.0f;
    for (int j = 0; j < 3; ++j)
        turn[j] = frame[j] + combined(turned[j].x, frame[0], turned[j].y, frame[1], turned[j].z, frame[2]);
    for (int node = 0; node < 10; ++node) {
        const triple d = get(x, node);
        for (int axis = 0; axis < 3; ++axis) {
            y[3 * node + axis] = dot(turn[axis], d) + at[node][0] * turned[axis].x + at[node][1] * turned[axis].y
                + at[node][2] * turned[axis].z;
        }
    }
};

// Forces g of displacements y, in the subtree's frame: by its stiffness as a whole, or leaf by leaf where these
// differ.
const auto add_linear = [&](const lanes8* y, lanes8* g) {
    if (!isotropic.stride) return multiply(y, g);
    #pragma clang loop unroll(disable)
    for (int leaf = 0; leaf < 8; ++leaf) {
        material_of(leaf);
        triple a[3];
        columns(y, nodes_of[leaf], a);
        // E = B^T C in the leaf's frame B, then P = B sigma.
        const float* b0 = frame_of[leaf];
        lanes8 e[3][3];
        for (int i = 0; i < 3; ++i) {
            const float* w = b0 + 3 * i;
            e[i][0] = w[0] * a[0].x + w[1] * a[0].y + w[2] * a[0].z;
            e[i][1] = w[0] * a[1].x + w[1] * a[1].y + w[2] * a[1].z;
            e[i][2] = w[0] * a[2].x + w[1] * a[2].y + w[2] * a[2].z;
        }
        m *= area; k *= area;
        const lanes8 pressure = k * (e[0][0] + e[1][1] + e[2][2]);
        const lanes8 xx = 2.0f * m * e[0][0] + pressure, yy = 2.0f * m * e[1][1] + pressure;
        const lanes8 zz = 2.0f * m * e[2][2] + pressure;
        const lanes8 xy = m * (e[0][1] + e[1][0]), xz = m * (e[0][2] + e[2][0]), yz = m * (e[1][2] + e[2][1]);
        const auto in_leaf = [&](const lanes8& s0, const lanes8& s1, const lanes8& s2) {
            return triple{b0[0] * s0 + b0[3] * s1 + b0[6] * s2, b0[1] * s0 + b0[4] * s1 + b0[7] * s2,
                b0[2] * s0 + b0[5] * s1 + b0[8] * s2};
        };
        const triple p[3] = {in_leaf(xx, xy, xz), in_leaf(xy, yy, yz), in_leaf(xz, yz, zz)};
        add_leaf(g, nodes_of[leaf], p);
    }
};

// Forces turned to where the subtree is, and none where not ``trusted``.
const auto turn_forces = [&](const triple* turn, const masks8& trusted, lanes8* g) {
    for (int node = 0; node < 10; ++node) {
        const triple d = get(g, node);
        const triple force = chosen(trusted, combined(d.x, turn[0], d.y, turn[1], d.z, turn[2]), nothing);
        g[3 * node] = force.x; g[3 * node + 1] = force.y; g[3 * node + 2] = force.z;
    }
};
