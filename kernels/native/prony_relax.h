// The known state after the step. In: prony.h. Out: material.
const auto keep = [&](int block, int i, const lanes8& values) {
    float* const to = known(block, i) + first_element;
    if (end == 8) { *reinterpret_cast<lanes8*>(to) = values; return; }
    for (int lane = 0; lane < end; ++lane) to[lane] = values[lane];
};
for (int term = 0; term < terms; ++term) {
    float left, mean;
    fading(term, left, mean);
    for (int i = 0; i < 6; ++i) keep(term + 1, i, left * values_of(known(term + 1, i)) + mean * change[i]);
}
for (int i = 0; i < 6; ++i) keep(0, i, strain[i]);
