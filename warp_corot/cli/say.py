"""What the command line says on stderr, one line each."""

import sys


def complain(message: str, kind: str = "error") -> None:
    """Print ``warp-corot: KIND: MESSAGE``, in one line whatever is in it."""
    text = " ".join(message.split())
    print(f"warp-corot: {kind}: {text}" if kind else f"warp-corot: {text}", file=sys.stderr, flush=True)
