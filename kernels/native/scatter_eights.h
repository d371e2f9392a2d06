// Adds the forces of eight elements, one after the other, if they are ``sound``. In: what gathers elements, with
// ``forces_of``; columns p of their stresses times the weight. Out: f; a bit for each element that is ``left_out``.
triple forces[4];
four parts[8][4];
forces_of(p, forces);
for (int n = 0; n < 4; ++n) part(forces[n], &parts[0][n], 4);
int left_out = 0;
for (int lane = 0; lane < end; ++lane) {
    if (!sound[lane]) { left_out |= 1 << lane; continue; }
    const wp::vec_t<4, wp::int32>& to = units.targets.data[first_element + lane];
    for (int n = 0; n < 4; ++n) *reinterpret_cast<four*>(&f.data[to[n]][0]) += parts[lane][n];
}
