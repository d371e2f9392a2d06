// Stresses under a law. In: what elements.h has gathered; isotropic; ``find_strain_there`` and ``stress`` of
// the law. Out: columns p of the stress times -V, and where it is ``sound``.
const lanes8 m = isotropic.stride ? values_of(isotropic.mu.data) : spread(isotropic.mu.data[0]);
const lanes8 k = isotropic.stride ? values_of(isotropic.lam.data) : spread(isotropic.lam.data[0]);
// Columns of the displacement gradient (d1 d2 d3) B.
triple a[3], f_[3], p[3];
for (int j = 0; j < 3; ++j) a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
lanes8 e[6];
find_strain_there(a, e, f_);
const masks8 sound = stress(f_, e, spread(1.0f), -volume * m, -volume * k, p);
