// Says which leaves were left out.
for (int lane = 0; lane < end; ++lane) flagged.data[first_subtree + lane] = static_cast<wp::uint8>(left_out[lane]);
