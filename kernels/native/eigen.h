// Eigenvalues and eigenvectors of symmetric matrices, by Jacobi's method; see math/eigen.py. In: SWEEPS. Out: ``eigen_of``.
const auto eigen_of = [&](const lanes8* s, lanes8* d, triple* v) {
    d[0] = s[0]; d[1] = s[1]; d[2] = s[2];
    lanes8 a01 = s[3], a02 = s[4], a12 = s[5];
    const lanes8 one = spread(1.0f), zero = spread(0.0f);
    v[0] = {one, zero, zero};
    v[1] = {zero, one, zero};
    v[2] = {zero, zero, one};
    const auto turn = [&](lanes8& app, lanes8& aqq, lanes8& apq, lanes8& arp, lanes8& arq, triple& p, triple& q) {
        const masks8 turns = apq != 0.0f;
        const lanes8 theta = 0.5f * (aqq - app) / (turns ? apq : one);
        const lanes8 size = theta < 0.0f ? -theta : theta;
        const lanes8 tangent = (theta < 0.0f ? -one : one) / (size + __builtin_elementwise_sqrt(theta * theta + 1.0f));
        const lanes8 t = turns ? tangent : zero, cosine = 1.0f / __builtin_elementwise_sqrt(t * t + 1.0f);
        const lanes8 sine = t * cosine, step = t * apq, rp = arp;
        app -= step;
        aqq += step;
        arp = cosine * rp - sine * arq;
        arq = sine * rp + cosine * arq;
        apq = zero;
        const triple before = p;
        p = before * cosine - q * sine;
        q = before * sine + q * cosine;
    };
    for (int sweep = 0; sweep < SWEEPS && any((a01 != 0.0f) | (a02 != 0.0f) | (a12 != 0.0f)); ++sweep) {
        turn(d[0], d[1], a01, a02, a12, v[0], v[1]);
        turn(d[0], d[2], a02, a01, a12, v[0], v[2]);
        turn(d[1], d[2], a12, a01, a02, v[1], v[2]);
    }
};
// exp(x) - 1 to all its digits, for x up to 80: powers of two, and a series of what they leave within ln(2) / 2.
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
