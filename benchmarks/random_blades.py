"""Random blades through twelve bodies: thin, adaptive, labelled, remeshed, strained, touching and others.

``python benchmarks/random_blades.py --blades 1000 [--device cuda:0] [--first SEED] [--json FILE]`` sends five blades
through each body, one after another, and checks after each what ``tests/support/blade_cases.py`` says: no inverted,
lost or doubled element, a closed surface, mass and momentum, and that no step was repeated. It prints a line for each
failure, which begins again with ``--first`` and ``--body``. The exit status is 1 if there was any.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from collections import Counter
from pathlib import Path

import warp as wp

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))
from blade_cases import BODIES, RandomBlades

#: Blades through one body.
EACH = 5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blades", type=int, default=1000, help="number of blades")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after about this time")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--body", choices=BODIES, help="only this body")
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--json", help="file for the numbers")
    args = parser.parse_args()
    wp.config.quiet, wp.config.enable_backward = True, False
    names = [args.body] if args.body else list(BODIES)
    done, failed = Counter(), []
    begin, seed = time.perf_counter(), args.first
    while done.total() < args.blades and time.perf_counter() - begin < args.seconds:
        for name in names:
            if time.perf_counter() - begin > args.seconds:
                break
            number = 0
            try:
                blades = RandomBlades(name, seed, args.device)
                for number in range(EACH):
                    if number:
                        blades.again()
                    blades.run()
                    done[name] += 1
            except Exception as error:  # any error is a failure, and the next body goes on
                done[name] += 1
                failed.append((name, seed, number, f"{type(error).__name__}: {str(error).strip()[:300]}"))
                print("failed:", *failed[-1], flush=True)
            gc.collect()
        seed += 1
        if seed % 2 == 0:
            print(f"{done.total()} blades, {len(failed)} failed, {time.perf_counter() - begin:.0f} s", flush=True)
    print(f"{done.total()} blades through {len(done)} bodies, {len(failed)} failed, on {args.device}")
    if args.json:
        Path(args.json).write_text(json.dumps({"blades": done, "failed": failed}, indent=1))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
