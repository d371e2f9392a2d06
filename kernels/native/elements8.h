// Eight elements, one after the other in memory, in the lanes of vector registers: what laws need of them, and their
// forces. A place ``at`` has, for laws, the ``frame``, the ``weight`` of stresses, the ``value`` of an array that has a number
// for each element (or one for all), and the ``columns`` of the gradient of nodal vectors.
#pragma once

#include "dilatation.h"

#if !defined(__CUDACC__)
namespace corot {

// The columns of the gradient of nodal vectors times the edge length, and the forces at the four nodes of columns of a
// stress times V / h, by the three shapes of the forest: sums and differences as tables/shapes.py has them.
template <int SHAPE, class S>
COROT_INLINE void shape_columns(const triple<S>& x0, const triple<S>& x1, const triple<S>& x2, const triple<S>& x3, triple<S>* a) {
    const float root2 = 1.4142135623730951f;
    a[0] = SHAPE == 2 ? (x0 - x2) * root2 : x1 - x0;
    a[1] = SHAPE == 2 ? (x1 - x2) * root2 : x2 - x1;
    a[2] = SHAPE == 2 ? (x3 - x2) * 2.0f : SHAPE == 1 ? (x3 - x2) + (x3 - x0) : x3 - x2;
}

template <int SHAPE, class S> COROT_INLINE void shape_forces(const triple<S>* p, triple<S>* force) {
    const float root2 = 1.4142135623730951f;
    if (SHAPE == 2) {
        const triple<S> p0 = p[0] * root2, p1 = p[1] * root2, p2 = p[2] * 2.0f;
        force[0] = -p0, force[1] = -p1, force[2] = p0 + p1 + p2, force[3] = -p2;
    } else {
        force[0] = SHAPE == 1 ? p[0] + p[2] : p[0];
        force[1] = p[1] - p[0], force[2] = p[2] - p[1], force[3] = SHAPE == 1 ? p[2] * -2.0f : -p[2];
    }
}

// The volume of a shape over its edge cubed, and how elements and subtrees code their shape: a level, whether they are
// mirrored, and the number of their frame.
constexpr float VOLUME[3] = {1.0f / 6, 1.0f / 12, 1.0f / 24};
constexpr int LEVEL_MASK = 63, MIRROR_BIT = 6, FRAME_SHIFT = 7;
constexpr float SIGNS[2] = {1.0f, -1.0f};

COROT_INLINE int least_of(int a, int b) { return a < b ? a : b; }

// The frame of the shape code of each lane, whose last column has the sign of its handedness.
template <class Units, class Code> COROT_INLINE Frame<lanes8> frame_of(const Units& units, const Code& code) {
    lanes8 axes[9];
    Frame<lanes8> frame;
    gather_matrix([&](int lane) { return units.frames.data[code(lane) >> FRAME_SHIFT].data[0]; }, axes);
    frame.handedness = gather_one([&](int lane) { return SIGNS + ((code(lane) >> MIRROR_BIT) & 1); });
    for (int j = 0; j < 3; ++j) frame.q[j] = {axes[j], axes[3 + j], axes[6 + j]};
    frame.q[2] = frame.q[2] * frame.handedness;
    return frame;
}

template <class Units, class Code> COROT_INLINE lanes8 edge_of(const Units& units, const Code& code) {
    return gather_one([&](int lane) { return &units.size.data[(code(lane) & LEVEL_MASK) / 3]; });
}

// Eight elements from ``first`` on; those past the last before ``stop`` are the last one again. ``numbers`` has the places of
// their values in the arrays of a material; without it these have the same places.
template <class Units_> struct Eight {
    typedef lanes8 N;
    const Units_& units;
    const int first, last, end;
    const int* const numbers;
    COROT_INLINE Eight(const Units_& units, int first, int stop, const int* numbers = nullptr)
        : units(units), first(first), last(stop - 1), end(least_of(8, stop - first)), numbers(numbers) {}
    COROT_INLINE int place(int lane) const { return least_of(first + lane, last); }
    COROT_INLINE int element(int lane) const { return numbers ? numbers[place(lane)] : place(lane); }
    // One of a value for each place.
    COROT_INLINE lanes8 placed(const float* values) const {
        return end == 8 ? load8(values + first) : gather_one([&](int lane) { return values + place(lane); });
    }
    COROT_INLINE lanes8 values_of(const float* values) const {
        return numbers ? gather_one([&](int lane) { return values + numbers[place(lane)]; }) : placed(values);
    }
    template <class Values> COROT_INLINE lanes8 value(const Values& values, int stride) const {
        return stride ? values_of(values.data) : spread<lanes8>(values.data[0]);
    }
    COROT_INLINE void write(const float* values, const lanes8& a) const {
        float* const to = const_cast<float*>(values) + first;
        if (end == 8) return store8(to, a);
        for (int lane = 0; lane < end; ++lane) to[lane] = a[lane];
    }
    COROT_INLINE masks8 done() const { return masks8{}; }
    // Vectors of the four nodes.
    template <class Vectors> COROT_INLINE void gather_nodes(const Vectors& vectors, triple<lanes8>* x) const {
        for (int n = 0; n < 4; ++n)
            x[n] = gather_vector([&](int lane) { return &vectors.data[units.nodes.data[place(lane)][n]][0]; });
    }
    // Adds forces at the four nodes, one element after the other.
    template <class Vectors> COROT_INLINE void add_forces(const triple<lanes8>* force, const Vectors& f) const {
        packed4 parts[8][4];
        for (int n = 0; n < 4; ++n) part(force[n], &parts[0][n], 4);
        for (int lane = 0; lane < end; ++lane) {
            const auto& to = units.nodes.data[place(lane)];
            for (int n = 0; n < 4; ++n) add4(&f.data[to[n]][0], parts[lane][n]);
        }
    }
    // Puts elements that are not ``valid`` on a list: how many, then which.
    template <class List> COROT_INLINE void list_invalid(const masks8& valid, const List& list) const {
        if (!any(inverted(valid))) return;
        for (int lane = 0; lane < end; ++lane)
            if (!valid[lane]) list.data[++list.data[0]] = element(lane);
    }
};

// General elements, by their rest matrices b.
template <class Units> struct GeneralEight : Eight<Units> {
    RestAxes<lanes8> frame;
    lanes8 b[9], volume;
    COROT_INLINE GeneralEight(const Units& units, int first, int stop)
        : Eight<Units>(units, first, stop, units.numbers.shape[0] ? units.numbers.data : nullptr) {
        gather_matrix([&](int lane) { return units.rest_inverse.data[this->place(lane)].data[0]; }, b);
        volume = this->placed(units.volume.data);
    }
    COROT_INLINE lanes8 weight() const { return -volume; }
    COROT_INLINE void columns(const triple<lanes8>* x, triple<lanes8>* a) const {
        const triple<lanes8> d1 = x[1] - x[0], d2 = x[2] - x[0], d3 = x[3] - x[0];
        for (int j = 0; j < 3; ++j) a[j] = combined(b[j], d1, b[3 + j], d2, b[6 + j], d3);
    }
    COROT_INLINE void forces_of(const triple<lanes8>* p, triple<lanes8>* force) const {
        for (int n = 0; n < 3; ++n) force[n + 1] = combined(b[3 * n], p[0], b[3 * n + 1], p[1], b[3 * n + 2], p[2]);
        force[0] = -(force[1] + force[2] + force[3]);
    }
};

// Elements of a forest.
template <class Units> struct ForestEight : Eight<Units> {
    Frame<lanes8> frame;
    lanes8 h;
    masks8 is_1, is_2;
    COROT_INLINE ForestEight(const Units& units, int first, int stop) : Eight<Units>(units, first, stop) {
        const auto code = [&](int lane) { return units.code.data[this->place(lane)]; };
        frame = frame_of(units, code);
        h = edge_of(units, code);
        masks8 shape;
        for (int lane = 0; lane < 8; ++lane) shape[lane] = (code(lane) & LEVEL_MASK) % 3;
        is_1 = shape == 1, is_2 = shape == 2;
    }
    COROT_INLINE void columns(const triple<lanes8>* x, triple<lanes8>* a) const {
        triple<lanes8> a1[3], a2[3];
        shape_columns<0>(x[0], x[1], x[2], x[3], a);
        shape_columns<1>(x[0], x[1], x[2], x[3], a1);
        shape_columns<2>(x[0], x[1], x[2], x[3], a2);
        const lanes8 inverse = 1.0f / h;
        for (int j = 0; j < 3; ++j) a[j] = chosen(is_2, a2[j], chosen(is_1, a1[j], a[j])) * inverse;
    }
    COROT_INLINE void forces_of(const triple<lanes8>* p, triple<lanes8>* force) const {
        triple<lanes8> scaled[3], f1[4], f2[4];
        for (int j = 0; j < 3; ++j) scaled[j] = p[j] * (-1.0f / h);
        shape_forces<0>(scaled, force);
        shape_forces<1>(scaled, f1);
        shape_forces<2>(scaled, f2);
        for (int n = 0; n < 4; ++n) force[n] = chosen(is_2, f2[n], chosen(is_1, f1[n], force[n]));
    }
};

// The columns of the gradient of nodal vectors, times the frame.
template <class At, class Vectors> COROT_INLINE void gradient_of(const At& at, const Vectors& vectors, triple<lanes8>* a) {
    triple<lanes8> x[4];
    at.gather_nodes(vectors, x);
    at.columns(x, a);
}

// Adds the forces of eight elements under a law, and lists those where its stress may not be trusted.
template <class At, class Law, class Vectors, class List>
COROT_INLINE void scatter_eight(const At& at, Law law, const Vectors& u, const Vectors& f, const List& missed) {
    triple<lanes8> a[3], p[3], force[4];
    law.begin(at);
    gradient_of(at, u, a);
    const masks8 valid = law.stress(deformation_of(a, at.frame), at, p);
    at.forces_of(p, force);
    at.add_forces(force, f);
    at.list_invalid(valid, missed);
}

template <class Units, class Law, class Vectors, class List>
COROT_INLINE void scatter_general(const Law& law, const Units& units, int block, int count, const Vectors& u, const Vectors& f,
        const List& missed) {
    scatter_eight(GeneralEight<Units>(units, 8 * block, count), law, u, f, missed);
}

// The same where nodes have positions x in the place of displacements.
template <class Units, class Law, class Vectors, class List>
COROT_INLINE void scatter_posed(const Law& law, const Units& units, int block, int count, const Vectors& x, const Vectors& f,
        const List& missed) {
    const GeneralEight<Units> at(units, 8 * block, count);
    triple<lanes8> a[3], p[3], force[4];
    gradient_of(at, x, a);
    a[0].x -= 1.0f; a[1].y -= 1.0f; a[2].z -= 1.0f;
    const masks8 valid = law.stress(deformation_of(a, at.frame), at, p);
    at.forces_of(p, force);
    at.add_forces(force, f);
    at.list_invalid(valid, missed);
}

}  // namespace corot
#endif
