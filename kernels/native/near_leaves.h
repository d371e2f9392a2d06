// Forces with the root's rotation, for subtrees in which it is near that of every leaf. Out: g, and
// where subtrees are ``done``.
masks8 done;
{
    triple turn[3], root[3];
    lanes8 root_e[6];
    root_strain(root_e, root);
    // |U - I| <= 1/2 implies |U^2 - I| <= 5/4: beyond, nothing is near, and the rotation need not be found.
    done = dot(get(root_e, 0), get(root_e, 0)) + 2.0f * dot(get(root_e, 1), get(root_e, 1)) < 1.5625f;
    if (any(done)) done &= rotation_of(root, root_e, mirror, turn);
    if (any(done)) {
        lanes8 y[30];
        turn_back(turn, y);
        done &= are_near(y);
        if (any(done)) {
            add_linear(y, g);
            turn_forces(turn, done, g);
        }
    }
}
