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
