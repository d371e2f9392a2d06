// theta = J - 1, with the digits of small strains. In and out as in dilatation_small.h.
const auto theta_of = [&](const triple* a, const triple* q, const lanes8& handedness) {
    const lanes8 linear = dot(a[0], q[0]) + dot(a[1], q[1]) + dot(a[2], q[2]);
    const triple crossed = cross(a[0], q[1]) + cross(q[0], a[1]);
    return linear + handedness * (dot(a[2], crossed) + dot(cross(a[0], a[1]), q[2] + a[2]));
};
const auto slopes_of = [&](const triple* a, const triple* q, const lanes8& handedness, triple* p) {
    const triple f0 = q[0] + a[0], f1 = q[1] + a[1], f2 = q[2] + a[2];
    p[0] = cross(f1, f2) * handedness;
    p[1] = cross(f2, f0) * handedness;
    p[2] = cross(f0, f1) * handedness;
};
const auto holding_of = [&](const lanes8& theta) {
    const lanes8 size = theta < 0.0f ? -theta : theta, beyond = size > FREE ? size - FREE : spread(0.0f);
    const lanes8 near = beyond < RAMP ? beyond : spread(RAMP), slope = (0.5f / RAMP) * near * near + (beyond - near);
    return theta < 0.0f ? -slope : slope;
};
