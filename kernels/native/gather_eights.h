// Vectors of the nodes of eight elements. In: what gathers elements, with ``columns``. Out: ``gathered``, the columns of
// (dv/dX) times the frame.
const auto gathered = [&](const auto& vectors, triple* a) {
    lanes8 corner[4];
    triple x[4];
    for (int n = 0; n < 4; ++n) {
        gather([&](int lane) { return &vectors.data[units.nodes.data[element(lane)][n]][0]; }, corner);
        x[n] = get(corner, 0);
    }
    columns(x, a);
};
