// The rotation of the subtree as one element. Out: turn, and where it is ``trusted``; elsewhere all leaves are left
// out.
triple turn[3], root[3];
lanes8 root_e[6];
root_strain(root_e, root);
const masks8 trusted = rotation_of(root, root_e, mirror, turn);
left_out = ~trusted & 255;
