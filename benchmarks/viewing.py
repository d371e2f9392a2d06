"""How many frames a second the page's server makes, how fast time passes, and what takes the time.

``python benchmarks/viewing.py [INPUT] [OPTION ...]`` takes the input and options of ``warp-corot view``. A visitor in
another process, without a screen, receives everything and draws nothing. The script needs the extra ``view``.
"""

from __future__ import annotations

import multiprocessing
import sys
import time

from warp_corot.cli import make_parser
from warp_corot.cli.run_setup import set_up
from warp_corot.viewing.commands import frame_told
from warp_corot.viewing.view import View

#: Duration of a measurement, and of the time before it [s].
SECONDS, BEFORE = 10.0, 3.0


def visitor(address: str, count) -> None:
    """Receive everything that a page sends, say of each frame that it is drawn, and count the bytes."""
    from websockets.sync.client import connect

    with connect(address, max_size=None, compression=None) as socket:
        while True:
            message = socket.recv()
            count.value += len(message)
            if b'"kind":"frame"' in message[4:24]:
                socket.send('{"do": "drawn"}')


def timed(work, seconds: float) -> float:
    """Mean time of a call [ms], over this many seconds."""
    calls, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        work()
        calls += 1
    return 1e3 * (time.perf_counter() - started) / calls


def main() -> None:
    given = sys.argv[1:] or ["warp:bunny", "--tets", "20000"]
    args = make_parser().parse_args(["view", *given])
    ready = set_up([args])
    own = [body.subject.skin or body.subject.surface for body in ready.bodies]
    count = multiprocessing.get_context("spawn").Value("q", 0)
    with View(ready.sim, port=0, own=own) as page:
        process = multiprocessing.get_context("spawn").Process(
            target=visitor, args=(f"ws://127.0.0.1:{page.port}/", count), daemon=True
        )
        process.start()
        session, shown = page.session, page.session.shown
        points, triangles = (
            sum(len(x) for x in each) for each in ([s.rest for s in shown], [s.triangles for s in shown])
        )
        elements = sum(body.element_count for body in session.sim.bodies)
        print(f"{' '.join(given)}: {elements} tetrahedra, {points} points, {triangles} triangles, {session.sim.device}")
        for name in ("stress", "displacement", ""):
            session.change(colors=name)
            session.change(fps=1000.0)
            session.pace.rest = 0.0
            for period in (30.0, 60.0, 120.0):
                session.change(fps=period)
                timed(page._show, BEFORE)
                sent, started, simulated = count.value, time.perf_counter(), session.sim.total_time
                frames, due = 0, started
                while time.perf_counter() - started < SECONDS:
                    page._show()
                    frames += 1
                    due = max(due + 1.0 / period, time.perf_counter())
                    time.sleep(max(due - time.perf_counter(), 0.0))
                took = time.perf_counter() - started
                print(
                    f"  {name or 'no colours'}, {period:g} a second asked for: {frames / took:.1f} frames/s, "
                    f"{(session.sim.total_time - simulated) / took:.3g} x real time, "
                    f"{(count.value - sent) / frames / 1e3:.0f} kB a frame"
                )
            session.change(running=False)
            print(f"    reading {timed(session.frame, 2.0):.2f} ms, ", end="")
            frame = session.frame()
            print(f"packing {timed(lambda f=frame: frame_told(session, f), 2.0):.2f} ms a frame")
            session.change(running=True)
        process.kill()


if __name__ == "__main__":
    main()
