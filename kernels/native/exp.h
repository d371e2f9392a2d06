// ``power_excess``: exp(x) - 1 to all its digits, for x up to 80: powers of two, and a series of what they leave within ln(2) / 2.
const auto power_excess = [&](const lanes8& x) {
    const lanes8 bounded = x < -80.0f ? spread(-80.0f) : x;
    const lanes8 near = 1.4426950f * bounded + (bounded < 0.0f ? spread(-0.5f) : spread(0.5f));
    const masks8 power = __builtin_convertvector(near, masks8);
    const lanes8 whole = __builtin_convertvector(power, lanes8);
    const lanes8 r = (bounded - 0.693359375f * whole) + 2.1219444e-4f * whole;
    const lanes8 series = r + 0.5f * r * r * (1.0f + r / 3.0f * (1.0f + r / 4.0f * (1.0f + r / 5.0f * (1.0f + r / 6.0f
        * (1.0f + r / 7.0f)))));
    const masks8 bits = (power + 127) << 23;
    const lanes8 scale = reinterpret_cast<const lanes8&>(bits);
    return scale * series + (scale - 1.0f);
};
