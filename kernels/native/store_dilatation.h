// In: element_dilatation.h. Out: theta, in ``shared`` at the elements' places.
const lanes8 theta = theta_of(a, axes, spread(1.0f));
for (int lane = 0; lane < there; ++lane) shared.data[place(lane)] = {theta[lane], 0.0f, 0.0f, 0.0f};
