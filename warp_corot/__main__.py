"""``python -m warp_corot``, and the command ``warp-corot``: Ctrl-C ends it quietly while Python is still importing."""

import sys


def main() -> int:
    """Run the command line as a separate process; returns the exit status."""
    try:
        import time

        from .cli import main as run

        return run(spent=time.process_time())
    except KeyboardInterrupt:
        sys.stderr.write("warp-corot: interrupted\n")
        return 130
    finally:
        import gc
        import signal

        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the rest of Python's shutdown takes no time
        gc.freeze()  # else its last collections go through the syntax trees of all kernels, which takes a second


if __name__ == "__main__":
    sys.exit(main())
