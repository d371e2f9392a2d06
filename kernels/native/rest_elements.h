// Eight elements at rest. In: side_by_side.h; units (``GeneralElements``). Out: rest matrices b and volumes.
lanes8 b[9];
gather_matrix([&](int lane) { return units.rest_inverse.data[element(lane)].data[0]; }, b);
const lanes8 volume = values_of(units.volume.data);
