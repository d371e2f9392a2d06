// Products with the exact derivative of corotated forces. In: what elements.h has gathered with kept_elements.h; isotropic;
// behind the gradients, strains e and matrices w (00, 11, 22, 01, 02, 12), both turned by the rotation. Out: columns p of
// the stress.
const lanes8 m = isotropic.stride ? values_of(isotropic.mu.data) : spread(isotropic.mu.data[0]);
const lanes8 k = isotropic.stride ? values_of(isotropic.lam.data) : spread(isotropic.lam.data[0]);
const lanes8 *e = b + 9, *w = b + 15;
const triple strain[3] = {{e[0], e[3], e[4]}, {e[3], e[1], e[5]}, {e[4], e[5], e[2]}};
triple a[3], changed[3], p[3];
for (int j = 0; j < 3; ++j) a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
const triple turns = {a[1].z - a[2].y, a[2].x - a[0].z, a[0].y - a[1].x};
const triple rows[3] = {{w[0], w[3], w[4]}, {w[3], w[1], w[5]}, {w[4], w[5], w[2]}};
const triple t = {dot(rows[0], turns), dot(rows[1], turns), dot(rows[2], turns)};
for (int j = 0; j < 3; ++j) changed[j] = cross(t, strain[j]);
for (int j = 0; j < 3; ++j) a[j] = a[j] - changed[j];
const lanes8 pressure = k * (a[0].x + a[1].y + a[2].z), held = k * (e[0] + e[1] + e[2]);
const lanes8 s01 = m * (a[0].y + a[1].x), s02 = m * (a[0].z + a[2].x), s12 = m * (a[1].z + a[2].y);
const lanes8 twice = 2.0f * m;
p[0] = triple{twice * a[0].x + pressure, s01 + held * t.z, s02 - held * t.y} + changed[0] * twice;
p[1] = triple{s01 - held * t.z, twice * a[1].y + pressure, s12 + held * t.x} + changed[1] * twice;
p[2] = triple{s02 + held * t.y, s12 - held * t.x, twice * a[2].z + pressure} + changed[2] * twice;
