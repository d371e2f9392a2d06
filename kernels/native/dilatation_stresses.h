// Stresses of a shared dilatation. In: element_dilatation.h; ``slopes_of`` of a law; isotropic; w' of the shared
// dilatation, the second number in ``shared``. Out: columns p of the stress times -V.
const lanes8 k = isotropic.stride ? gather_one([&](int lane) { return isotropic.lam.data + place(lane); })
    : spread(isotropic.lam.data[0]);
const lanes8 slope = gather_one([&](int lane) { return &shared.data[place(lane)][1]; });
const lanes8 numbers = {0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f};
const lanes8 pressure = slope + holding_of(theta_of(a, axes, spread(1.0f)));
const lanes8 weight = numbers < 1.0f * there ? -volume * k * pressure : spread(0.0f);
triple p[3];
slopes_of(a, axes, spread(1.0f), p);
for (int j = 0; j < 3; ++j) p[j] = p[j] * weight;
