// Vectors of eight lanes, triples of them, and what gathers and scatters them. Nodes are three vectors each, at 3 *
// node.
typedef float lanes8 __attribute__((vector_size(32), aligned(4)));
typedef int masks8 __attribute__((vector_size(32)));
typedef float four __attribute__((vector_size(16), aligned(4)));
// For functions that are called more than once: if they are not inlined, Clang takes vectors that are passed by reference
// for aligned ones, which they are not on the stack.
#define INLINED __attribute__((always_inline))
struct triple {
    lanes8 x, y, z;
    triple operator+(const triple& b) const { return {x + b.x, y + b.y, z + b.z}; }
    triple operator-(const triple& b) const { return {x - b.x, y - b.y, z - b.z}; }
    triple operator-() const { return {-x, -y, -z}; }
    triple operator*(const lanes8& w) const { return {w * x, w * y, w * z}; }
    triple operator*(float w) const { return {w * x, w * y, w * z}; }
};
// a + w b
const auto added = [](const triple& a, const lanes8& w, const triple& b) {
    return triple{a.x + w * b.x, a.y + w * b.y, a.z + w * b.z};
};
// u a + v b + w c
const auto combined = [](const lanes8& u, const triple& a, const lanes8& v, const triple& b, const lanes8& w,
        const triple& c) {
    return triple{u * a.x + v * b.x + w * c.x, u * a.y + v * b.y + w * c.y, u * a.z + v * b.z + w * c.z};
};
const auto dot = [](const triple& a, const triple& b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
const auto cross = [](const triple& a, const triple& b) {
    return triple{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
};
const auto spread = [](float a) { return lanes8{a, a, a, a, a, a, a, a}; };
const auto get = [](const lanes8* a, int node) { return triple{a[3 * node], a[3 * node + 1], a[3 * node + 2]}; };
const auto add = [](lanes8* a, int node, const triple& b) {
    a[3 * node] += b.x; a[3 * node + 1] += b.y; a[3 * node + 2] += b.z;
};
const auto chosen = [](const masks8& which, const triple& a, const triple& b) {
    return triple{which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z};
};
const triple nothing = {spread(0.0f), spread(0.0f), spread(0.0f)};
const auto any = [](const masks8& a) { return __builtin_reduce_or(a) != 0; };
const masks8 every = spread(0.0f) == spread(0.0f);
const auto halves = [](const float* low, const float* high) {
    const four a = *reinterpret_cast<const four*>(low), b = *reinterpret_cast<const four*>(high);
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
};
// Four floats in each lane, which begin at at(lane).
const auto gather = [&](const auto& at, lanes8* to) {
    const auto r0 = halves(at(0), at(4)), r1 = halves(at(1), at(5));
    const auto r2 = halves(at(2), at(6)), r3 = halves(at(3), at(7));
    const auto a = __builtin_shufflevector(r0, r1, 0, 8, 1, 9, 4, 12, 5, 13);
    const auto b = __builtin_shufflevector(r2, r3, 0, 8, 1, 9, 4, 12, 5, 13);
    const auto c = __builtin_shufflevector(r0, r1, 2, 10, 3, 11, 6, 14, 7, 15);
    const auto d = __builtin_shufflevector(r2, r3, 2, 10, 3, 11, 6, 14, 7, 15);
    to[0] = __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13);
    to[1] = __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
    to[2] = __builtin_shufflevector(c, d, 0, 1, 8, 9, 4, 5, 12, 13);
    to[3] = __builtin_shufflevector(c, d, 2, 3, 10, 11, 6, 7, 14, 15);
};
// One float in each lane.
const auto gather_one = [](const auto& at) {
    return lanes8{*at(0), *at(1), *at(2), *at(3), *at(4), *at(5), *at(6), *at(7)};
};
// The nine entries of a matrix in each lane, row by row.
const auto gather_matrix = [&](const auto& at, lanes8* to) {
    gather(at, to);
    gather([&](int lane) { return at(lane) + 4; }, to + 4);
    to[8] = gather_one([&](int lane) { return at(lane) + 8; });
};
// The triple of each lane as four floats, lanes ``stride`` apart.
const auto part = [](const triple& a, four* to, int stride) {
    const lanes8 zero = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    const auto xy = __builtin_shufflevector(a.x, a.y, 0, 8, 1, 9, 4, 12, 5, 13);
    const auto z0 = __builtin_shufflevector(a.z, zero, 0, 8, 1, 9, 4, 12, 5, 13);
    const auto xy_ = __builtin_shufflevector(a.x, a.y, 2, 10, 3, 11, 6, 14, 7, 15);
    const auto z0_ = __builtin_shufflevector(a.z, zero, 2, 10, 3, 11, 6, 14, 7, 15);
    to[0] = __builtin_shufflevector(xy, z0, 0, 1, 8, 9);
    to[stride] = __builtin_shufflevector(xy, z0, 2, 3, 10, 11);
    to[2 * stride] = __builtin_shufflevector(xy_, z0_, 0, 1, 8, 9);
    to[3 * stride] = __builtin_shufflevector(xy_, z0_, 2, 3, 10, 11);
    to[4 * stride] = __builtin_shufflevector(xy, z0, 4, 5, 12, 13);
    to[5 * stride] = __builtin_shufflevector(xy, z0, 6, 7, 14, 15);
    to[6 * stride] = __builtin_shufflevector(xy_, z0_, 4, 5, 12, 13);
    to[7 * stride] = __builtin_shufflevector(xy_, z0_, 6, 7, 14, 15);
};
// P = F S of a symmetric S: 00, 11, 22, 01, 02, 12.
const auto times = [&](const triple* f, const lanes8* s, triple* p) {
    p[0] = combined(s[0], f[0], s[3], f[1], s[4], f[2]);
    p[1] = combined(s[3], f[0], s[1], f[1], s[5], f[2]);
    p[2] = combined(s[4], f[0], s[5], f[1], s[2], f[2]);
};
