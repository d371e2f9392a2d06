// Symmetric tensors (00, 11, 22, 01, 02, 12) of eight elements, from their frames to the axes of rest space and back.
// In: frame, whose columns are orthonormal. And vectors from the axes of rest space ``to_frame``.
const auto out_of_frame = [&](const lanes8* s, lanes8* to) {
    triple v[3];
    times(frame, s, v);
    const triple *q = frame;
    to[0] = v[0].x * q[0].x + v[1].x * q[1].x + v[2].x * q[2].x;
    to[1] = v[0].y * q[0].y + v[1].y * q[1].y + v[2].y * q[2].y;
    to[2] = v[0].z * q[0].z + v[1].z * q[1].z + v[2].z * q[2].z;
    to[3] = v[0].x * q[0].y + v[1].x * q[1].y + v[2].x * q[2].y;
    to[4] = v[0].x * q[0].z + v[1].x * q[1].z + v[2].x * q[2].z;
    to[5] = v[0].y * q[0].z + v[1].y * q[1].z + v[2].y * q[2].z;
};
const auto into_frame = [&](const lanes8* s, lanes8* to) {
    triple v[3];
    const triple rows[3] = {{s[0], s[3], s[4]}, {s[3], s[1], s[5]}, {s[4], s[5], s[2]}};
    for (int j = 0; j < 3; ++j) v[j] = {dot(rows[0], frame[j]), dot(rows[1], frame[j]), dot(rows[2], frame[j])};
    for (int j = 0; j < 3; ++j) to[j] = dot(frame[j], v[j]);
    to[3] = dot(frame[0], v[1]);
    to[4] = dot(frame[0], v[2]);
    to[5] = dot(frame[1], v[2]);
};
const auto to_frame = [&](const triple& a) { return triple{dot(frame[0], a), dot(frame[1], a), dot(frame[2], a)}; };
