// Says which leaves were left out, a byte a subtree. In: left_out. Out: missed.
for (int lane = 0; lane < end; ++lane) missed.data[first_subtree + lane] = static_cast<wp::uint8>(left_out[lane]);
