// Eight complete subtrees of a type, in the lanes of vector registers: ten displacements in, ten forces out. ``Type`` has the
// tables of the type (subtrees/cpu.py): its SHAPE; NODES of each leaf; in the subtree's Maubach frame, rest positions AT of
// the nodes over a leaf's edge, and FRAME and HAND of each leaf; the different columns AXES of these frames, and which three
// make the frame of a leaf (AXES_OF).
#pragma once

#include "elements8.h"

namespace corot {

// A leaf of each of eight subtrees; see elements8.h for what a place has.
template <class Subtrees> struct Leaf {
    typedef lanes8 N;
    const Subtrees& of;
    const int number;
    const masks8 excluded;
    Frame<lanes8> frame;
    COROT_INLINE lanes8 weight() const { return of.area; }
    COROT_INLINE int element(int lane) const { return of.starts[lane] + number; }
    COROT_INLINE masks8 done() const { return excluded; }
    COROT_INLINE lanes8 values_of(const float* values) const {
        return gather_one([&](int lane) { return values + element(lane); });
    }
    template <class Values> COROT_INLINE lanes8 value(const Values& values, int stride) const {
        return stride ? values_of(values.data) : spread<lanes8>(values.data[0]);
    }
    // Of vectors at the ten nodes.
    COROT_INLINE void columns(const triple<lanes8>* x, triple<lanes8>* a) const {
        const int* n = Subtrees::type::NODES[number];
        shape_columns<Subtrees::type::SHAPE>(x[n[0]], x[n[1]], x[n[2]], x[n[3]], a);
    }
    COROT_INLINE void add_forces(const triple<lanes8>* p, triple<lanes8>* g) const {
        const int* n = Subtrees::type::NODES[number];
        triple<lanes8> force[4];
        shape_forces<Subtrees::type::SHAPE>(p, force);
        for (int k = 0; k < 4; ++k) g[n[k]] = g[n[k]] + force[k];
    }
};

// ``x`` are displacements of the ten nodes from the first in edge lengths h of a leaf, ``frame`` is the Maubach frame. Past
// the last of ``count`` subtrees it is the last one again.
template <class Type, class Units_> struct EightSubtrees {
    typedef Type type;
    static constexpr int LEAVES = 8;
    const Units_& units;
    const int first, count, end;
    Frame<lanes8> frame;
    lanes8 h, area;
    int starts[8];  // the first leaf of each among the mesh's elements
    triple<lanes8> x[10], axes[Type::AXES_COUNT];
    template <class Vectors>
    COROT_INLINE EightSubtrees(const Units_& units, int block, int count, const Vectors& u)
        : units(units), first(8 * block), count(count), end(least_of(8, count - 8 * block)) {
        const auto code = [&](int lane) { return units.code.data[place(lane)]; };
        frame = frame_of(units, code);
        h = 0.5f * edge_of(units, code);
        // Stresses of a leaf times this add up to forces.
        area = VOLUME[Type::SHAPE] * h * h;
        gather_nodes(u, x);
        for (int lane = 0; lane < 8; ++lane) starts[lane] = units.first.data[place(lane)];
        for (int i = 0; i < Type::AXES_COUNT; ++i)
            axes[i] = frame.q[0] * Type::AXES[i][0] + frame.q[1] * Type::AXES[i][1] + frame.q[2] * Type::AXES[i][2];
    }
    COROT_INLINE int place(int lane) const { return least_of(first + lane, count - 1); }
    // Vectors of the ten nodes from the first, over h.
    template <class Vectors> COROT_INLINE void gather_nodes(const Vectors& vectors, triple<lanes8>* x) const {
        const lanes8 inverse = 1.0f / h;
        const auto node = [&](int k) {
            return gather_vector([&](int lane) { return &vectors.data[units.nodes.data[10 * place(lane) + k]][0]; });
        };
        const triple<lanes8> origin = node(0);
        x[0] = nothing<lanes8>();
        for (int k = 1; k < 10; ++k) x[k] = (node(k) - origin) * inverse;
    }
    COROT_INLINE Leaf<EightSubtrees> leaf(int number, const masks8& done = masks8{}) const {
        const int* c = Type::AXES_OF[number];
        return {*this, number, done, {{axes[c[0]], axes[c[1]], axes[c[2]]}, Type::HAND[number] * frame.handedness}};
    }
    template <class Vectors> COROT_INLINE void add_forces(const triple<lanes8>* g, const Vectors& f) const {
        packed4 parts[8][10];
        for (int k = 0; k < 10; ++k) part(g[k], &parts[0][k], 10);
        for (int lane = 0; lane < end; ++lane) {
            const int* node = units.nodes.data + 10 * (first + lane);
            for (int k = 0; k < 10; ++k) add4(&f.data[node[k]][0], parts[lane][k]);
        }
    }
    // Says which leaves were left out, a byte a subtree.
    template <class Bytes> COROT_INLINE void flag(const masks8& degenerate, const Bytes& flags) const {
        for (int lane = 0; lane < end; ++lane) flags.data[first + lane] = static_cast<unsigned char>(degenerate[lane]);
    }
};

// Adds the forces of all leaves to those of the nodes, each under a law by itself, and a bit for each leaf that is left out;
// the law does nothing in lanes that are ``done``.
template <class Subtrees, class Law>
COROT_INLINE void add_leaves(const Subtrees& subtrees, const Law& law, const masks8& done, triple<lanes8>* g, masks8& degenerate) {
#if defined(__clang__)
#pragma clang loop unroll(disable)
#endif
    for (int number = 0; number < 8; ++number) {
        const auto leaf = subtrees.leaf(number, done);
        triple<lanes8> a[3], p[3];
        leaf.columns(subtrees.x, a);
        const masks8 valid = law.stress(deformation_of(a, leaf.frame), leaf, p);
        degenerate |= ~valid & ~done & (1 << number);
        leaf.add_forces(p, g);
    }
}

// Forces of eight subtrees under a law; leaves that are left out are flagged, if the law leaves any out (SOME).
template <class Type, bool SOME, class Law, class Units, class Vectors, class Bytes>
COROT_INLINE void scatter_subtrees(Law law, const Units& units, int block, int count, const Vectors& u, const Vectors& f,
        const Bytes& flags) {
    const EightSubtrees<Type, Units> subtrees(units, block, count, u);
    triple<lanes8> g[10];
    for (int k = 0; k < 10; ++k) g[k] = nothing<lanes8>();
    masks8 degenerate = {};
    law.begin(subtrees);
    add_leaves(subtrees, law, masks8{}, g, degenerate);
    subtrees.add_forces(g, f);
    if constexpr (SOME) subtrees.flag(degenerate, flags);
}

// --- corotated forces of all leaves with one rotation -----------------------------------------------------------------

// The rotation of the subtree as one element: columns of R times the frame, and where it may be trusted.
template <class Subtrees> COROT_INLINE Deformation<lanes8, Frame<lanes8>> root_of(const Subtrees& subtrees) {
    const triple<lanes8>* x = subtrees.x;
    triple<lanes8> a[3];
    shape_columns<Subtrees::type::SHAPE>(x[0], x[1], x[2], x[3], a);
    // The subtree's edge is two of a leaf's.
    for (int j = 0; j < 3; ++j) a[j] = a[j] * 0.5f;
    return deformation_of(a, subtrees.frame);
}

// Displacements y in the subtree's Maubach frame, where the leaves are linear elements. The columns ``turned`` of R - I in
// this frame are, for a rotation by less than a right angle, made of its axial vector, which has its digits however small it
// is, by Rodrigues' formula; and ``turn`` is made the same R's.
template <class Subtrees> COROT_INLINE void turn_back(const Subtrees& subtrees, triple<lanes8>* turn, triple<lanes8>* y) {
    const triple<lanes8>* frame = subtrees.frame.q;
    triple<lanes8> turned[3];
    lanes8 r[3][3];
    for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) r[i][j] = dot(frame[i], turn[j]);
    const lanes8 x_ = 0.5f * (r[2][1] - r[1][2]), y_ = 0.5f * (r[0][2] - r[2][0]), z_ = 0.5f * (r[1][0] - r[0][1]);
    const lanes8 cosine = 0.5f * (r[0][0] + r[1][1] + r[2][2] - 1.0f), w = 1.0f / (1.0f + cosine);
    const lanes8 xx_ = w * x_ * x_, yy_ = w * y_ * y_, zz_ = w * z_ * z_;
    const lanes8 xy_ = w * x_ * y_, xz_ = w * x_ * z_, yz_ = w * y_ * z_;
    const masks8 acute = cosine > 0.0f;
    turned[0].x = acute ? -yy_ - zz_ : r[0][0] - 1.0f;
    turned[0].y = acute ? xy_ + z_ : r[1][0];
    turned[0].z = acute ? xz_ - y_ : r[2][0];
    turned[1].x = acute ? xy_ - z_ : r[0][1];
    turned[1].y = acute ? -xx_ - zz_ : r[1][1] - 1.0f;
    turned[1].z = acute ? yz_ + x_ : r[2][1];
    turned[2].x = acute ? xz_ + y_ : r[0][2];
    turned[2].y = acute ? yz_ - x_ : r[1][2];
    turned[2].z = acute ? -xx_ - yy_ : r[2][2] - 1.0f;
    for (int j = 0; j < 3; ++j)
        turn[j] = frame[j] + combined(turned[j].x, frame[0], turned[j].y, frame[1], turned[j].z, frame[2]);
    for (int node = 0; node < 10; ++node) {
        const triple<lanes8>& d = subtrees.x[node];
        const float* at = Subtrees::type::AT[node];
        y[node] = {dot(turn[0], d) + at[0] * turned[0].x + at[1] * turned[0].y + at[2] * turned[0].z,
            dot(turn[1], d) + at[0] * turned[1].x + at[1] * turned[1].y + at[2] * turned[1].z,
            dot(turn[2], d) + at[0] * turned[2].x + at[1] * turned[2].y + at[2] * turned[2].z};
    }
}

// Adds to forces g those of displacements y, in the subtree's frame: by its stiffness as a whole, or leaf by leaf where
// these differ.
template <class Subtrees, class Material>
COROT_INLINE void add_linear(const Subtrees& subtrees, const Material& isotropic, const triple<lanes8>* y, triple<lanes8>* g) {
    typedef typename Subtrees::type Type;
    // The stiffness is over the subtree's edge, two of a leaf's.
    if (!isotropic.stride) return Type::multiply(y, -2.0f * subtrees.h * subtrees.h, isotropic.lam.data[0], isotropic.mu.data[0], g);
#if defined(__clang__)
#pragma clang loop unroll(disable)
#endif
    for (int number = 0; number < 8; ++number) {
        const auto leaf = subtrees.leaf(number);
        const lanes8 m = subtrees.area * leaf.value(isotropic.mu, 1), k = subtrees.area * leaf.value(isotropic.lam, 1);
        triple<lanes8> a[3], p[3];
        leaf.columns(y, a);
        // The strain e of columns a = B C in the leaf's frame B, and columns B sigma(e) of the stress.
        const auto& b = Type::FRAME[number];
        lanes8 e[3][3];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) e[i][j] = b[i][0] * a[j].x + b[i][1] * a[j].y + b[i][2] * a[j].z;
        const lanes8 pressure = k * (e[0][0] + e[1][1] + e[2][2]);
        const lanes8 xy = m * (e[0][1] + e[1][0]), xz = m * (e[0][2] + e[2][0]), yz = m * (e[1][2] + e[2][1]);
        const lanes8 sigma[3][3] = {{2.0f * m * e[0][0] + pressure, xy, xz}, {xy, 2.0f * m * e[1][1] + pressure, yz},
            {xz, yz, 2.0f * m * e[2][2] + pressure}};
        for (int j = 0; j < 3; ++j)
            p[j] = {b[0][0] * sigma[j][0] + b[1][0] * sigma[j][1] + b[2][0] * sigma[j][2],
                b[0][1] * sigma[j][0] + b[1][1] * sigma[j][1] + b[2][1] * sigma[j][2],
                b[0][2] * sigma[j][0] + b[1][2] * sigma[j][1] + b[2][2] * sigma[j][2]};
        leaf.add_forces(p, g);
    }
}

// Forces turned to where the subtree is, and none where not ``trusted``.
COROT_INLINE void turn_forces(const triple<lanes8>* turn, const masks8& trusted, triple<lanes8>* g) {
    for (int node = 0; node < 10; ++node)
        g[node] = chosen(trusted, combined(g[node].x, turn[0], g[node].y, turn[1], g[node].z, turn[2]), nothing<lanes8>());
}

// Forces of eight subtrees, of a material with Lame's parameters and rotations (``RotatedMaterial``): ``GIVEN`` ones from
// further up the tree, or the roots'; where these are not trusted, all leaves are left out.
template <class Type, bool GIVEN, class Units, class Material, class Vectors, class Bytes>
COROT_INLINE void scatter_subtrees_shared(const Units& units, int block, int count, const Material& material, const Vectors& u,
        const Vectors& f, const Bytes& flags) {
    const EightSubtrees<Type, Units> subtrees(units, block, count, u);
    triple<lanes8> turn[3], y[10], g[10];
    masks8 trusted = every<lanes8>();
    if (GIVEN) {
        lanes8 r[9];
        gather_matrix([&](int lane) { return material.rotations.data[material.unit.data[subtrees.place(lane)]].data[0]; }, r);
        for (int j = 0; j < 3; ++j) {
            const triple<lanes8>& q = subtrees.frame.q[j];
            turn[j] = {r[0] * q.x + r[1] * q.y + r[2] * q.z, r[3] * q.x + r[4] * q.y + r[5] * q.z,
                r[6] * q.x + r[7] * q.y + r[8] * q.z};
        }
    } else {
        trusted = rotation_of(root_of(subtrees), turn);
    }
    for (int k = 0; k < 10; ++k) g[k] = nothing<lanes8>();
    turn_back(subtrees, turn, y);
    add_linear(subtrees, material.isotropic, y, g);
    turn_forces(turn, trusted, g);
    subtrees.add_forces(g, f);
    subtrees.flag(~trusted & 255, flags);
}

// Whether |skew E| <= tolerance and |sym E| <= 1/2 in every leaf, for displacements y turned back. E is C B^T, with the
// columns C of a leaf's gradient and its frame B.
template <class Type> COROT_INLINE masks8 are_near(const triple<lanes8>* y, float tolerance) {
    const lanes8 bound = spread<lanes8>(tolerance * tolerance);
    masks8 near = every<lanes8>();
#if defined(__clang__)
#pragma clang loop unroll(full)
#endif
    for (int number = 0; number < 8; ++number) {
        const int* n = Type::NODES[number];
        const auto& b = Type::FRAME[number];
        triple<lanes8> a[3], twice = nothing<lanes8>();
        shape_columns<Type::SHAPE>(y[n[0]], y[n[1]], y[n[2]], y[n[3]], a);
        for (int c = 0; c < 3; ++c) {
            // Most entries of frames are zero, and terms with these vanish when the loop is unrolled.
            if (b[c][0] != 0.0f) twice.y += b[c][0] * a[c].z, twice.z -= b[c][0] * a[c].y;
            if (b[c][1] != 0.0f) twice.z += b[c][1] * a[c].x, twice.x -= b[c][1] * a[c].z;
            if (b[c][2] != 0.0f) twice.x += b[c][2] * a[c].y, twice.y -= b[c][2] * a[c].x;
        }
        const lanes8 skew = 0.5f * dot(twice, twice);
        const lanes8 whole = dot(a[0], a[0]) + dot(a[1], a[1]) + dot(a[2], a[2]);
        near &= (skew <= bound) & (whole - skew <= 0.25f);
    }
    return near;
}

// Corotated forces of eight subtrees with the root's rotation where it is near that of every leaf; elsewhere under
// ``law``. ``rest`` is what the law adds to the corotated one, for all lanes; ``ADDS``: it adds something.
template <class Type, bool ADDS, class Law, class Rest, class Units, class Material, class Vectors, class Bytes>
COROT_INLINE void scatter_subtrees_tolerance(Law law, Rest rest, const Units& units, int block, int count, const Material& isotropic,
        float tolerance, const Vectors& u, const Vectors& f, const Bytes& flags) {
    const EightSubtrees<Type, Units> subtrees(units, block, count, u);
    triple<lanes8> g[10];
    for (int k = 0; k < 10; ++k) g[k] = nothing<lanes8>();
    masks8 degenerate = {};
    const auto root = root_of(subtrees);
    const lanes8* e = root.e;
    // |U - I| <= 1/2 implies |U^2 - I| <= 5/4: beyond, nothing is near, and the rotation need not be found.
    masks8 done = e[0] * e[0] + e[1] * e[1] + e[2] * e[2] + 2.0f * (e[3] * e[3] + e[4] * e[4] + e[5] * e[5]) < 1.5625f;
    triple<lanes8> turn[3], y[10];
    if (any(done)) done &= rotation_of(root, turn);
    if (any(done)) {
        turn_back(subtrees, turn, y);
        done &= are_near<Type>(y, tolerance);
        if (any(done)) {
            add_linear(subtrees, isotropic, y, g);
            turn_forces(turn, done, g);
        }
    }
    if (any(~done)) {
        law.begin(subtrees);
        add_leaves(subtrees, law, done, g, degenerate);
    } else if (ADDS) {
        masks8 none = {};
        rest.begin(subtrees);
        add_leaves(subtrees, rest, masks8{}, g, none);
    }
    subtrees.add_forces(g, f);
    subtrees.flag(degenerate, flags);
}

}  // namespace corot
