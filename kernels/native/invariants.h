// Adjugate and invariants, and J - 1 from these where E is small: |E|^2 < 0.4. In: E and det F. Out: ``invariants``.
struct invariants { lanes8 adjugate[6], a, b, c, squared, j; masks8 small; };
const auto invariants_of = [&](const lanes8* e, const lanes8& det) {
    invariants i;
    i.adjugate[0] = e[1] * e[2] - e[5] * e[5];
    i.adjugate[1] = e[0] * e[2] - e[4] * e[4];
    i.adjugate[2] = e[0] * e[1] - e[3] * e[3];
    i.adjugate[3] = e[4] * e[5] - e[3] * e[2];
    i.adjugate[4] = e[3] * e[5] - e[4] * e[1];
    i.adjugate[5] = e[3] * e[4] - e[0] * e[5];
    i.a = e[0] + e[1] + e[2];
    i.b = i.adjugate[0] + i.adjugate[1] + i.adjugate[2];
    i.c = e[0] * i.adjugate[0] + e[3] * i.adjugate[3] + e[4] * i.adjugate[4];
    i.squared = i.a * i.a - 2.0f * i.b;
    i.small = (i.squared < 0.4f) & (det > 0.0f);
    i.j = i.small ? (i.a + i.b + i.c) / (1.0f + det) : det - 1.0f;
    return i;
};
