// Maxwell elements beside the law in eight elements; see prony.py. In: gather_eights.h; material (``PronyMaterial``); u;
// the time since the known state. Out: columns f_ of F; the deviator of Green's strain in the axes of rest space (00,
// 11, 22, 01, 02, 12) and its ``change``; ``known``, the place of a number of a tensor of the first element; ``fading``.
triple a[3], f_[3];
lanes8 e[6], strain[6], change[6];
gathered(u, a);
strain_of(a, e, f_);
const lanes8 mean_strain = (e[0] + e[1] + e[2]) / 6.0f;
for (int i = 0; i < 6; ++i) e[i] = 0.5f * e[i] - (i < 3 ? mean_strain : spread(0.0f));
out_of_frame(e, strain);
const auto known = [&](int block, int i) { return material.known.data + (6 * block + i) * size_t(material.count); };
for (int i = 0; i < 6; ++i) change[i] = strain[i] - values_of(known(0, i));
// exp(-t / tau) and the share of the change that is left.
const auto fading = [&](int term, float& left, float& mean) {
    const float x = time / material.tau.data[term];
    left = wp::exp(-x);
    mean = x > 0.02f ? (1.0f - left) / x : 1.0f - 0.5f * x * (1.0f - x / 3.0f * (1.0f - 0.25f * x));
};
const int terms = material.g.shape[0];
