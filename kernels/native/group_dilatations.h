// Some groups of elements that share their dilatation. In: units (``GeneralElements``, group after group), block, count
// of groups, u; material (``GroupedMaterial``); GROUPS a thread, MOST elements in a group; ``theta_of`` and
// ``pressure_of`` of a law. Out: the elements from ``begin`` to ``stop``; of eight after eight of them the columns of
// their displacement gradients; lambda times their shared w', ``pressures``.
const int groups = material.live.shape[0] ? wp::min(count, material.live.data[0]) : count;
const int first_group = wp::min(GROUPS * block, groups), last_group = wp::min(first_group + GROUPS, groups);
const int* starts = material.starts.data;
const int begin = starts[first_group], stop = starts[last_group];
const triple axes[3] = {{spread(1.0f), spread(0.0f), spread(0.0f)}, {spread(0.0f), spread(1.0f), spread(0.0f)},
    {spread(0.0f), spread(0.0f), spread(1.0f)}};
triple gradients[GROUPS * MOST / 8 + 1][3];
float pressures[GROUPS * MOST + 8];
for (int first_element = begin, eight = 0; first_element < stop; first_element += 8, ++eight) {
    const int count = stop;
