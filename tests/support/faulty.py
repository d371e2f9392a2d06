"""A run on several ranks, in which rank 1 ends in the middle: ``mpirun -n 2 python faulty.py killed out.usda``."""

import os
import signal
import sys
import time

import warp as wp

wp.config.quiet = True
wp.config.enable_backward = False

import warp_corot as wc  # noqa: E402
import warp_corot.distributed as wd  # noqa: E402


def end(sim: wd.Simulation) -> None:
    if sim.rank == 1 and sim.steps >= 16:
        if sys.argv[1] == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if sys.argv[1] == "hung":
            time.sleep(1e4)
        raise ValueError("rank 1 has had enough")


def main() -> None:
    mesh = wc.TetForest.box((1, 1, 3), 0.064, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(800.0, 0.3, 1000.0), device="cpu")
    body.fix("z == zmin")
    sim = wd.Simulation(body)
    sim.on_step(end, every=8)
    sim.advance(1e4)


if __name__ == "__main__":
    main()
