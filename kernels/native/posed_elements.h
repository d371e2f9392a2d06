// Corotated stresses of Newton's tetrahedra, which have positions in the place of displacements. In: what elements.h
// has gathered; isotropic, of each; the law. Out: columns p of the stress times -V, and where it is ``sound``.
const lanes8 m = values_of(isotropic.mu.data), k = values_of(isotropic.lam.data);
// Columns of F = (x1-x0 x2-x0 x3-x0) B and of F - I.
triple a[3], f_[3], p[3], same[3];
for (int j = 0; j < 3; ++j) a[j] = f_[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
a[0].x -= 1.0f; a[1].y -= 1.0f; a[2].z -= 1.0f;
lanes8 e[6];
find_strain_there(a, e, same);
const masks8 sound = stress(f_, e, spread(1.0f), -volume * m, -volume * k, p);
