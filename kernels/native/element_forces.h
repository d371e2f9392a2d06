// Adds the forces of eight elements, one after the other. In: what elements.h has gathered; the columns p of their
// stresses times -V. Out: f.
four parts[8][4];
triple rest = nothing;
for (int n = 1; n < 4; ++n) {
    const lanes8* row = b + 3 * (n - 1);
    const triple force = combined(row[0], p[0], row[1], p[1], row[2], p[2]);
    rest = rest - force;
    part(force, &parts[0][n], 4);
}
part(rest, &parts[0][0], 4);
for (int lane = 0; lane < end; ++lane) {
    const wp::vec_t<4, wp::int32>& to = units.nodes.data[first_element + lane];
    for (int n = 0; n < 4; ++n) *reinterpret_cast<four*>(&f.data[to[n]][0]) += parts[lane][n];
}
