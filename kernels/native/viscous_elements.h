// Viscous stresses of eight elements. In: gather_eights.h; ``viscous`` and ``rotation_of``; material (``ViscousMaterial``);
// u. Out: columns p of the stresses times the weight, and where there is a good rotation.
const auto viscosity = [&](const wp::array_t<wp::float32>& of) {
    return material.seconds * weight * (material.isotropic.stride ? values_of(of.data) : spread(of.data[0]));
};
triple a[3], f_[3], r[3], c[3], p[3];
lanes8 e[6];
gathered(u, a);
strain_of(a, e, f_);
const masks8 sound = rotation_of(f_, e, handedness, r);
gathered(material.velocities, c);
viscous(f_, r, c, viscosity(material.isotropic.mu), viscosity(material.isotropic.lam), p);
