// Adds the forces g of eight subtrees, one after the other.
four parts[8][10];
for (int k = 0; k < 10; ++k) part(get(g, k), &parts[0][k], 10);
for (int lane = 0; lane < end; ++lane) {
    const int* node = subtrees.nodes.data + 10 * (first_subtree + lane);
    for (int k = 0; k < 10; ++k) *reinterpret_cast<four*>(&f.data[node[k]][0]) += parts[lane][k];
}
