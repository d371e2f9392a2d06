// Viscous stress of eight elements; see viscosity.py. In: columns f of F, r of R and c of the rate of F, all in one
// frame; viscosities m and k; LEAST. Out: columns p of P.
const auto viscous = [&](const triple* f, const triple* r, const triple* c, const lanes8& m, const lanes8& k, triple* p) {
    // U: 00, 11, 22, 01, 02, 12. M = tr U I - U, and its inverse times its determinant.
    const lanes8 stretch[6] = {dot(r[0], f[0]), dot(r[1], f[1]), dot(r[2], f[2]), 0.5f * (dot(r[0], f[1]) + dot(r[1], f[0])),
        0.5f * (dot(r[0], f[2]) + dot(r[2], f[0])), 0.5f * (dot(r[1], f[2]) + dot(r[2], f[1]))};
    const triple u[3] = {{stretch[0], stretch[3], stretch[4]}, {stretch[3], stretch[1], stretch[5]},
        {stretch[4], stretch[5], stretch[2]}};
    const triple turn[3] = {{stretch[1] + stretch[2], -stretch[3], -stretch[4]},
        {-stretch[3], stretch[0] + stretch[2], -stretch[5]}, {-stretch[4], -stretch[5], stretch[0] + stretch[1]}};
    const triple adjugate[3] = {cross(turn[1], turn[2]), cross(turn[2], turn[0]), cross(turn[0], turn[1])};
    const lanes8 det = dot(turn[0], adjugate[0]);
    const masks8 crushed = (det < LEAST) | (dot(u[0], cross(u[1], u[2])) < 0.0f);
    const lanes8 inverse = crushed ? spread(0.0f) : 1.0f / det;
    const auto solve = [&](const triple& x) {
        return triple{dot(adjugate[0], x) * inverse, dot(adjugate[1], x) * inverse, dot(adjugate[2], x) * inverse};
    };
    // Columns of A, then of A - W U.
    triple a[3];
    for (int j = 0; j < 3; ++j) a[j] = {dot(r[0], c[j]), dot(r[1], c[j]), dot(r[2], c[j])};
    const triple w = solve({a[1].z - a[2].y, a[2].x - a[0].z, a[0].y - a[1].x});
    for (int j = 0; j < 3; ++j) a[j] = a[j] - cross(w, u[j]);
    const lanes8 pressure = k * (a[0].x + a[1].y + a[2].z), twice = 2.0f * m;
    const lanes8 s01 = m * (a[0].y + a[1].x), s02 = m * (a[0].z + a[2].x), s12 = m * (a[1].z + a[2].y);
    triple s[3] = {{twice * a[0].x + pressure, s01, s02}, {s01, twice * a[1].y + pressure, s12},
        {s02, s12, twice * a[2].z + pressure}};
    // The axial vector of U s, from products of columns.
    const triple turning = solve({dot(u[2], s[1]) - dot(u[1], s[2]), dot(u[0], s[2]) - dot(u[2], s[0]),
        dot(u[1], s[0]) - dot(u[0], s[1])});
    s[0] = s[0] + triple{spread(0.0f), turning.z, -turning.y};
    s[1] = s[1] + triple{-turning.z, spread(0.0f), turning.x};
    s[2] = s[2] + triple{turning.y, -turning.x, spread(0.0f)};
    for (int j = 0; j < 3; ++j) p[j] = combined(s[j].x, r[0], s[j].y, r[1], s[j].z, r[2]);
};
