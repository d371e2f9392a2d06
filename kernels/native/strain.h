// E = C - I (00, 11, 22, 01, 02, 12) without cancellation, for laws in the deformation gradient.

// In: columns a of the displacement gradient and those of the rest frame. Out: e in that frame, and columns f of F.
const auto find_strain = [&](const triple* a, const triple* frame, lanes8* e, triple* f) {
    triple h[3];
    for (int j = 0; j < 3; ++j) h[j] = added(frame[j], spread(0.5f), a[j]);
    for (int j = 0; j < 3; ++j) e[j] = 2.0f * dot(a[j], h[j]);
    e[3] = dot(a[0], h[1]) + dot(a[1], h[0]);
    e[4] = dot(a[0], h[2]) + dot(a[2], h[0]);
    e[5] = dot(a[1], h[2]) + dot(a[2], h[1]);
    for (int j = 0; j < 3; ++j) f[j] = frame[j] + a[j];
};

// The same where the frame is the identity.
const auto find_strain_there = [&](const triple* a, lanes8* e, triple* f) {
    e[0] = 2.0f * a[0].x + dot(a[0], a[0]);
    e[1] = 2.0f * a[1].y + dot(a[1], a[1]);
    e[2] = 2.0f * a[2].z + dot(a[2], a[2]);
    e[3] = a[0].y + a[1].x + dot(a[0], a[1]);
    e[4] = a[0].z + a[2].x + dot(a[0], a[2]);
    e[5] = a[1].z + a[2].y + dot(a[1], a[2]);
    for (int j = 0; j < 3; ++j) f[j] = a[j];
    f[0].x += 1.0f; f[1].y += 1.0f; f[2].z += 1.0f;
};
