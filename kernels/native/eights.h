// Elements in eights. In: block. Out: the first of eight.
const int first_element = 8 * block;
