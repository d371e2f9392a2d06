// Adds the viscous forces of eight elements, one after the other. In: what gathers them, ``viscous`` and ``rotation_of``;
// material (``ViscousMaterial``); u. Out: f. Returns a bit for each element without a good rotation, which is left out.
const auto gathered = [&](const auto& vectors, triple* a) {
    lanes8 corner[4];
    triple x[4];
    for (int n = 0; n < 4; ++n) {
        gather([&](int lane) { return &vectors.data[units.nodes.data[element(lane)][n]][0]; }, corner);
        x[n] = get(corner, 0);
    }
    columns(x, a);
};
const auto parameter = [&](const float* values) {
    return material.seconds * weight * (material.isotropic.stride ?
        gather_one([&](int lane) { return values + element(lane); }) : spread(values[0]));
};
triple a[3], f_[3], r[3], c[3], p[3], forces[4];
lanes8 e[6];
gathered(u, a);
strain_of(a, e, f_);
const masks8 sound = rotation_of(f_, e, handedness, r);
gathered(material.velocities, c);
viscous(f_, r, c, parameter(material.isotropic.mu.data), parameter(material.isotropic.lam.data), p);
forces_of(p, forces);
four parts[8][4];
for (int n = 0; n < 4; ++n) part(forces[n], &parts[0][n], 4);
int left_out = 0;
for (int lane = 0; lane < end; ++lane) {
    if (!sound[lane]) { left_out |= 1 << lane; continue; }
    const wp::vec_t<4, wp::int32>& to = units.targets.data[first_element + lane];
    for (int n = 0; n < 4; ++n) *reinterpret_cast<four*>(&f.data[to[n]][0]) += parts[lane][n];
}
return left_out;
