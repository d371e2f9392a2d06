// The small strain (00, 11, 22, 01, 02, 12), in the place of E, and the frame in the place of F.

// In: columns a of the displacement gradient and those of the rest frame. Out: e in that frame, and the frame as f.
const auto find_strain = [&](const triple* a, const triple* frame, lanes8* e, triple* f) {
    for (int j = 0; j < 3; ++j) e[j] = dot(frame[j], a[j]);
    e[3] = 0.5f * (dot(frame[0], a[1]) + dot(frame[1], a[0]));
    e[4] = 0.5f * (dot(frame[0], a[2]) + dot(frame[2], a[0]));
    e[5] = 0.5f * (dot(frame[1], a[2]) + dot(frame[2], a[1]));
    for (int j = 0; j < 3; ++j) f[j] = frame[j];
};

// The same where the frame is the identity.
const auto find_strain_there = [&](const triple* a, lanes8* e, triple* f) {
    e[0] = a[0].x, e[1] = a[1].y, e[2] = a[2].z;
    e[3] = 0.5f * (a[0].y + a[1].x), e[4] = 0.5f * (a[0].z + a[2].x), e[5] = 0.5f * (a[1].z + a[2].y);
    for (int j = 0; j < 3; ++j) f[j] = nothing;
    f[0].x = f[1].y = f[2].z = spread(1.0f);
};
