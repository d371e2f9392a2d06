// Eight elements whose products are found again and again. In: side_by_side.h; PLACES; material.gradients, of which
// ``turned_gradients.h`` says what they are. Out: as rest_elements.h, with these in the place of rest matrices and -1 for
// volumes, since forces are minus the product.
const lanes8* b = reinterpret_cast<const lanes8*>(&material.gradients.data[PLACES * block][0]);
const lanes8 volume = spread(-1.0f);
