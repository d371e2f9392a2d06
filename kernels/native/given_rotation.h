// In: material (``RotatedMaterial``). Out: turn.
triple turn[3];
gather_matrix([&](int lane) { return material.rotations.data[material.unit.data[place(lane)]].data[0]; }, axes);
const triple rotation[3] = {{axes[0], axes[3], axes[6]}, {axes[1], axes[4], axes[7]}, {axes[2], axes[5], axes[8]}};
for (int j = 0; j < 3; ++j) {
    turn[j] = combined(frame[j].x, rotation[0], frame[j].y, rotation[1], frame[j].z, rotation[2]);
}
const masks8 trusted = every;
