// Forces of all leaves with the rotation of ``turn``, where it is ``trusted``. Turns x back. Out: g.
turn_back(turn, x);
add_linear(x, g);
turn_forces(turn, trusted, g);
