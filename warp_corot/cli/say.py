"""How a command ends: its exit status, and the line on stderr that says why."""

import signal
import sys

EXIT_CODES = """exit status:
  0    done
  1    a file could not be written, as when the disk is full
  2    bad input, said in one line; nothing was simulated, no file touched
  3    the state became not finite; the frames before are kept
  130  interrupted (Ctrl-C), 143 terminated (SIGTERM); the frames written are kept"""


class Terminated(KeyboardInterrupt):
    """SIGTERM has come."""


def interrupt_status(signalled: KeyboardInterrupt) -> int:
    """What a shell expects of a program that a signal has ended."""
    return 128 + (signal.SIGTERM if isinstance(signalled, Terminated) else signal.SIGINT)


def complain(message: str, kind: str = "error") -> None:
    """Print ``warp-corot: KIND: MESSAGE``, in one line whatever is in it."""
    text = " ".join(message.split())
    print(f"warp-corot: {kind}: {text}" if kind else f"warp-corot: {text}", file=sys.stderr, flush=True)
