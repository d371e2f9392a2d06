// General elements that share their dilatation in groups, group after group: a thread takes GROUPS of them.
#pragma once

#include "elements8.h"

namespace corot {

// Forces under a law, whose lambda is zero, and of the shared dilatation. ``material`` (``GroupedMaterial``) has the groups'
// starts and lambda; MOST is the number of elements that a group has at most.
template <class Of, int GROUPS, int MOST, class Law, class Units, class Material, class Vectors, class List>
COROT_INLINE void scatter_groups(Law law, const Units& units, int block, int count, const Material& material, const Vectors& u,
        const Vectors& f, const List& missed) {
    const int groups = material.live.shape[0] ? least_of(count, material.live.data[0]) : count;
    const int first_group = least_of(GROUPS * block, groups), last_group = least_of(first_group + GROUPS, groups);
    const int* starts = material.starts.data;
    const int begin = starts[first_group], stop = starts[last_group];
    triple<lanes8> gradients[GROUPS * MOST / 8 + 1][3];
    float thetas[GROUPS * MOST + 8], shares[GROUPS * MOST + 8], pressures[GROUPS * MOST + 8];
    for (int first = begin, eight = 0; first < stop; first += 8, ++eight) {
        const GeneralEight<Units> at(units, first, stop);
        gradient_of(at, u, gradients[eight]);
        store8(thetas + 8 * eight, Of::theta(gradients[eight], at.frame));
        store8(shares + 8 * eight, at.volume * at.value(material.lam, material.isotropic.stride));
    }
    for (int group = first_group; group < last_group; ++group) {
        float sum = 0.0f, weight = 0.0f;
        for (int t = starts[group]; t < starts[group + 1]; ++t) {
            sum += shares[t - begin] * thetas[t - begin];
            weight += shares[t - begin];
        }
        const lanes8 slope = Of::pressure(spread<lanes8>(weight != 0.0f ? sum / weight : 0.0f));
        for (int t = starts[group]; t < starts[group + 1]; ++t) pressures[t - begin] = slope[0];
    }
    for (int first = begin, eight = 0; first < stop; first += 8, ++eight) {
        const GeneralEight<Units> at(units, first, stop);
        const auto d = deformation_of(gradients[eight], at.frame);
        triple<lanes8> p[3], force[4];
        law.begin(at);
        const masks8 valid = law.stress(d, at, p);
        add_pressure<Of>(d, load8(thetas + 8 * eight), load8(pressures + 8 * eight), -load8(shares + 8 * eight), p);
        at.forces_of(p, force);
        at.add_forces(force, f);
        at.list_invalid(valid, missed);
    }
}

}  // namespace corot
