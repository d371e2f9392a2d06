// Eight elements whose products are found again and again. In: PLACES; material.gradients, of which ``turned_gradients.h``
// says what they are; units, first_element, count. Out: as rest_elements.h, with these in the place of rest matrices and -1
// for volumes, since forces are minus the product.
const int end = wp::min(8, count - first_element);
const auto element = [&](int lane) { return wp::min(first_element + lane, count - 1); };
const auto values_of = [&](const float* values) {
    return end == 8 ? *reinterpret_cast<const lanes8*>(values + first_element)
        : gather_one([&](int lane) { return values + element(lane); });
};
const lanes8* b = reinterpret_cast<const lanes8*>(&material.gradients.data[PLACES * block][0]);
const lanes8 volume = spread(-1.0f);
