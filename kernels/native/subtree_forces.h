// Adds the forces of eight subtrees, one after the other. In: what subtrees.h has gathered; forces g. Out: f.
four parts[8][10];
for (int k = 0; k < 10; ++k) part(get(g, k), &parts[0][k], 10);
for (int lane = 0; lane < end; ++lane) {
    const int* node = units.nodes.data + 10 * (first_subtree + lane);
    for (int k = 0; k < 10; ++k) *reinterpret_cast<four*>(&f.data[node[k]][0]) += parts[lane][k];
}
