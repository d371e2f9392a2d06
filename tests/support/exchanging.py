"""Exchanges between cards, or between ranks that share one: ``mpirun -n 3 python exchanging.py``."""

import numpy as np
import warp as wp

wp.config.quiet = True

from warp_corot.distributed import mpi  # noqa: E402
from warp_corot.distributed.exchange import CardExchange, ExchangeLists, PeerExchange, are_peers  # noqa: E402
from warp_corot.kernels.distributed.exchange import EXCHANGED  # noqa: E402

NODES, ROUNDS = 5000, 7


@wp.kernel(enable_backward=False)
def raise_owned(own: wp.array[wp.uint8], step: float, values: wp.array[wp.vec4]):
    i = wp.tid()
    if own[i] != wp.uint8(0):
        values[i] += wp.vec4(step)


def exchange_among(comm, kinds):
    """This rank's device, the numbers of its nodes, whether it owns them, and an exchange; the first rank owns no node
    that another one has, and the last has no ghosts."""
    mpi.choose_device()
    device, rng = wp.get_device(), np.random.default_rng(comm.rank)
    shared = np.arange(NODES)
    owner = np.random.default_rng(0).integers(1, comm.size, NODES).astype(np.int32)
    if comm.rank == comm.size - 1:
        shared = shared[owner[shared] == comm.rank]
    nodes = rng.permutation(np.concatenate([shared, NODES + 10 * comm.rank + np.arange(10)]))
    owner = np.concatenate([owner, np.repeat(np.arange(comm.size, dtype=np.int32), 10)])[nodes]
    lists = ExchangeLists.of(nodes, owner, 1, comm)
    made = PeerExchange if are_peers(device.alias) else CardExchange
    return device, nodes, owner == comm.rank, made(lists, device, kinds)


def main():
    comm = mpi.world()
    device, nodes, own, exchange = exchange_among(comm, EXCHANGED)
    for turn in range(ROUNDS):
        for kind in EXCHANGED:
            width = len(wp.zeros(1, dtype=kind, device="cpu").numpy().ravel())
            expected = (turn + nodes[:, None] * 8 + np.arange(width)).squeeze()
            given = np.where(own.reshape(-1, *[1] * (expected.ndim - 1)), expected, -1)
            values = wp.array(given, dtype=kind, device=device)
            exchange.launch(values)
            np.testing.assert_array_equal(values.numpy().reshape(expected.shape), expected)
    values = wp.zeros(len(nodes), dtype=wp.vec4, device=device)
    is_own = wp.array(own.astype(np.uint8), device=device)
    with wp.ScopedCapture(device=device) as capture:
        for step in range(ROUNDS):
            wp.launch(raise_owned, len(nodes), [is_own, float(step)], [values], device=device)
            exchange.launch(values)
    for turn in range(1, ROUNDS):
        wp.capture_launch(capture.graph)
        np.testing.assert_array_equal(values.numpy(), turn * sum(range(ROUNDS)))
    print(f"rank {comm.rank}: {type(exchange).__name__}, as expected")


if __name__ == "__main__":
    main()
