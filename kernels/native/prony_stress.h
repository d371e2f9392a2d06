// The stresses of the Maxwell elements. In: prony.h. Out: columns p of the stresses times the weight; ``sound``.
lanes8 sum[6], second[6];
for (int i = 0; i < 6; ++i) sum[i] = spread(0.0f);
for (int term = 0; term < terms; ++term) {
    float left, mean;
    fading(term, left, mean);
    const float g = material.g.data[term];
    for (int i = 0; i < 6; ++i) sum[i] += (g * left) * values_of(known(term + 1, i)) + (g * mean) * change[i];
}
into_frame(sum, second);
const auto& mu = material.isotropic.mu;
const lanes8 twice = 2.0f * weight * (material.isotropic.stride ? values_of(mu.data) : spread(mu.data[0]));
for (int i = 0; i < 6; ++i) second[i] *= twice;
triple p[3];
times(f_, second, p);
const masks8 sound = every;
