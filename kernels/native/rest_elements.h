// Eight elements at rest. In: units (``GeneralElements``), first_element, count. Out: their number ``end``; ``element``
// of a lane, the last one again where there are no more; rest matrices b and volumes.
const int end = wp::min(8, count - first_element);
const auto element = [&](int lane) { return wp::min(first_element + lane, count - 1); };
lanes8 b[9];
gather_matrix([&](int lane) { return units.rest_inverse.data[element(lane)].data[0]; }, b);
// Values of elements, side by side.
const auto values_of = [&](const float* values) {
    return end == 8 ? *reinterpret_cast<const lanes8*>(values + first_element)
        : gather_one([&](int lane) { return values + element(lane); });
};
const lanes8 volume = values_of(units.volume.data);
