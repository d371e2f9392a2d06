// Gradients of the hat functions of the last three nodes, turned by the rotation of F and times the root of the volume:
// 9 x 8 floats of eight elements, side by side. In: what elements.h has gathered; rotation.h. Out: f, of which 18 places
// are those of eight elements; where no rotation is found, they are not ``sound``.
triple a[3], f_[3], turn[3];
for (int j = 0; j < 3; ++j) a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
lanes8 e[6];
find_strain_there(a, e, f_);
const masks8 sound = rotation_of(f_, e, spread(1.0f), turn);
lanes8 root;
for (int lane = 0; lane < 8; ++lane) root[lane] = __builtin_sqrtf(volume[lane]);
lanes8* to = reinterpret_cast<lanes8*>(&f.data[18 * block][0]);
for (int n = 0; n < 3; ++n) {
    const triple h = combined(b[3 * n], turn[0], b[3 * n + 1], turn[1], b[3 * n + 2], turn[2]) * root;
    to[3 * n] = h.x; to[3 * n + 1] = h.y; to[3 * n + 2] = h.z;
}
