// Values of eight elements side by side. In: first_element, count. Out: how many there are up to the ``end``; ``element`` of
// a lane, the last one again where there are no more; ``values_of`` elements.
const int end = wp::min(8, count - first_element);
const auto element = [&](int lane) { return wp::min(first_element + lane, count - 1); };
const auto values_of = [&](const float* values) {
    return end == 8 ? *reinterpret_cast<const lanes8*>(values + first_element)
        : gather_one([&](int lane) { return values + element(lane); });
};
