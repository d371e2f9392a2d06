"""Tables of clusters of pairs; see ``pairs``."""

import warp as wp

from warp_corot.kernels.tables.cluster_layout import BANK_GROUPS

from .pairs import PAIR_TASK_SLOTS, SLOT_BITS, WORD_SLOTS

# Loops are not unrolled: unrolled, they take a compiler most of a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 0})


@wp.func
def readers(busy: wp.uint32, slot: int):
    """How many read from the slot's banks; four bits a group."""
    return int((busy >> wp.uint32(4 * (slot % BANK_GROUPS))) & wp.uint32(15))


@wp.kernel(enable_backward=False)
def pack_slots(
    # In
    zero: int,
    count: wp.array[wp.int32],
    given: wp.array2d[wp.int32],
    # Out
    packed: wp.array2d[wp.uint32],
):
    """Pack the slots of eight tasks, in an order in which threads seldom want the same banks at once.

    Eight threads read 16 bytes each at once, from eight groups of banks. A task may read its slots in any order. It may
    also choose which of the eight slots that are zero, from ``zero`` on, stands in for a slot that it does not have. A
    word that is not needed holds the first of these only.

    Args:
        count: How many slots each task has, [tasks].
        given: Which, [tasks, 12].
        packed: [tasks, 4].
    """
    first = BANK_GROUPS * wp.tid()
    taken0 = wp.uint64(0)
    taken1 = wp.uint64(0)
    for k in range(PAIR_TASK_SLOTS):
        busy = wp.uint32(0)
        for t in range(BANK_GROUPS):
            task = first + t
            room = WORD_SLOTS * ((count[task] + WORD_SLOTS - 1) / WORD_SLOTS)
            slot = zero
            if k < room:
                calmest = zero
                for group in range(1, BANK_GROUPS):
                    if readers(busy, zero + group) < readers(busy, calmest):
                        calmest = zero + group
                least = int(1000)
                choice = int(0)
                for j in range(room):
                    # Twelve bits a task, five tasks to a word.
                    taken = taken0
                    if t >= 5:
                        taken = taken1
                    if (taken >> wp.uint64(PAIR_TASK_SLOTS * (t % 5) + j)) & wp.uint64(1) == wp.uint64(0):
                        tried = calmest
                        cost = 2 * readers(busy, calmest) + 1
                        if j < count[task]:
                            tried = given[task, j]
                            cost = 2 * readers(busy, tried)
                        if cost < least:
                            least = cost
                            choice = j
                            slot = tried
                bit = wp.uint64(1) << wp.uint64(PAIR_TASK_SLOTS * (t % 5) + choice)
                if t < 5:
                    taken0 = taken0 | bit
                else:
                    taken1 = taken1 | bit
                busy += wp.uint32(1) << wp.uint32(4 * (slot % BANK_GROUPS))
            number = wp.uint32(slot) << wp.uint32(SLOT_BITS * (k % WORD_SLOTS))
            packed[task, k / WORD_SLOTS] = packed[task, k / WORD_SLOTS] | number


@wp.kernel(enable_backward=False)
def cut_clusters(
    # In
    of_pairs: wp.array2d[wp.int32],
    threads: int,
    # In and out
    cluster_of: wp.array[wp.int32],
    degree: wp.array[wp.int32],
    # Out
    begins: wp.array[wp.int32],
    count: wp.array[wp.int32],
):
    """Cut pairs, by their nodes [pairs, 5], into clusters of no more pairs or tasks than threads: where these begin,
    and how many there are. One thread does it; ``cluster_of``, -1 to begin with, and ``degree`` have a place a node.
    """
    cluster = int(-1)
    tasks = int(0)
    begin = int(0)
    for i in range(of_pairs.shape[0]):
        more = int(threads)
        if cluster >= 0 and i - begin < threads:
            more = int(0)
            for k in range(5):
                node = of_pairs[i, k]
                if cluster_of[node] != cluster or degree[node] % PAIR_TASK_SLOTS == 0:
                    more += 1
            # Without a second element, the fifth node repeats the first and may be one too many for its task.
            if of_pairs[i, 4] == of_pairs[i, 0]:
                more += 1
        if cluster < 0 or i - begin >= threads or tasks + more > threads:
            cluster += 1
            begins[cluster] = i
            begin = i
            tasks = 0
        for k in range(5):
            node = of_pairs[i, k]
            if cluster_of[node] != cluster:
                cluster_of[node] = cluster
                degree[node] = 0
            if degree[node] % PAIR_TASK_SLOTS == 0:
                tasks += 1
            degree[node] += 1
    count[0] = cluster + 1
