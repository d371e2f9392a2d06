"""An exchange between cards of one machine in one launch: each writes into the others' memory and waits for theirs."""

import warp as wp

from warp_corot.kernels.stepping.threads import block_count, synchronize_block

wp.set_module_options({"enable_backward": False})

#: Threads of a block, and the most blocks: those that wait for other cards leave room for the launches beside them.
BLOCK, MOST_BLOCKS = 256, 64
#: The numbers of ``clock``: exchanges so far, and this one's blocks that have sent and that have ended.
CLOCK = 3


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<unsigned*>(address) = word;
#endif
""")
def write_word(address: wp.uint64, word: wp.uint32):
    """Write to memory of another card."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("st.release.sys.global.u32 [%0], %1;" :: "l"(address), "r"(word) : "memory");
#endif
""")
def release_word(address: wp.uint64, word: wp.uint32):
    """The same; who acquires the word sees what was written before."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned found;
    do asm volatile("ld.acquire.sys.global.u32 %0, [%1];" : "=r"(found) : "l"(&wp::index(words, i)) : "memory");
    while (static_cast<int>(found - least) < 0);
#endif
""")
def acquire_word(words: wp.array[wp.uint32], i: int, least: wp.uint32):
    """Wait until a word that another card writes has this value or a later one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence_system();
#endif
""")
def fence_system():
    """What this thread, and those that it has waited for, have written is seen by other cards before what follows."""
    ...


@wp.kernel(enable_backward=False, grid_stride=False)
def exchange(
    # In
    words: int,
    sent: wp.array[wp.int32],
    targets: wp.array2d[wp.uint64],
    signals: wp.array[wp.uint64],
    received: wp.array[wp.int32],
    room: wp.array2d[wp.uint32],
    arrived: wp.array[wp.uint32],
    # In and out
    clock: wp.array[wp.uint32],
    values: wp.array2d[wp.uint32],
):
    """Give ghosts the values of the cards that own them; blocks of ``BLOCK`` threads, at most ``MOST_BLOCKS``.

    Args:
        words: 32-bit words of a value.
        sent, received: The places in ``values`` of what is sent and received.
        targets: Where each sent value goes, for even and for odd exchanges: a card that has this one's value of an
            exchange may still read that of the one before.
        signals: Of each neighbour, where it counts the exchanges of this card.
        room, arrived: What neighbours write: the values, for even and for odd exchanges, and the numbers of exchanges.
    """
    thread = wp.tid()
    threads = BLOCK * block_count()
    number = clock[0] + wp.uint32(1)
    half = int(number & wp.uint32(1))
    for i in range(thread, words * sent.shape[0], threads):
        entry = i // words
        word = i - words * entry
        write_word(targets[half, entry] + wp.uint64(4 * word), values[sent[entry], word])
    synchronize_block()
    if thread % BLOCK == 0:
        fence_system()
        if int(wp.atomic_add(clock, 1, wp.uint32(1))) == block_count() - 1:
            fence_system()
            for k in range(signals.shape[0]):
                release_word(signals[k], number)
        for k in range(arrived.shape[0]):
            acquire_word(arrived, k, number)
    synchronize_block()
    for i in range(thread, words * received.shape[0], threads):
        entry = i // words
        values[received[entry], i - words * entry] = room[half, i]
    synchronize_block()
    if thread % BLOCK != 0:
        return
    if int(wp.atomic_add(clock, 2, wp.uint32(1))) == block_count() - 1:
        clock[1] = wp.uint32(0)
        clock[2] = wp.uint32(0)
        clock[0] = number
