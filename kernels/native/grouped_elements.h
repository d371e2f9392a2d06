    // Stresses under a law, with the shared dilatation. In: rest_elements.h; isotropic, which has no lambda;
    // ``find_strain_there``, ``stress`` and ``slopes_of``. Out: columns p of the stress times -V, where it is ``sound``.
    const lanes8 m = isotropic.stride ? values_of(isotropic.mu.data) : spread(isotropic.mu.data[0]);
    const triple* a = gradients[eight];
    triple f_[3], p[3], slopes[3];
    lanes8 e[6];
    find_strain_there(a, e, f_);
    const masks8 sound = stress(f_, e, spread(1.0f), -volume * m, spread(0.0f), p);
    slopes_of(a, axes, spread(1.0f), slopes);
    const lanes8 pressure = -volume * *reinterpret_cast<const lanes8*>(pressures + 8 * eight);
    for (int j = 0; j < 3; ++j) p[j] = added(p[j], pressure, slopes[j]);
