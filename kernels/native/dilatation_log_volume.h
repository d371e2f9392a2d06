// Neo-Hookean: w = (ln J)^2 / 2 of the theta in dilatation_of_volume.h, continued below J0 = CONTINUED_BELOW. In:
// ``log_of``.
const auto pressure_of = [&](const lanes8& theta) {
    const float j0 = CONTINUED_BELOW, log0 = -0.6931472f;
    const masks8 crushed = theta < j0 - 1.0f;
    const lanes8 safe = crushed ? spread(0.0f) : theta;
    const lanes8 line = spread(log0 / j0) + (1.0f - log0) / (j0 * j0) * (theta + (1.0f - j0));
    return crushed ? line : log_of(safe) / (1.0f + safe);
};
