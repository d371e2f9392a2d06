// Corotated: w = theta^2 / 2 of the theta in dilatation_of_volume.h.
const auto pressure_of = [&](const lanes8& theta) { return theta; };
