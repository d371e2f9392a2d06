"""The start of Warp, without its message that there is no card."""

import os
import sys
import tempfile

import warp as wp


def start_warp() -> None:
    """Start Warp, which writes straight to the terminal; hide its message that there is no NVIDIA driver.

    Raises:
        OSError: Warp cannot make the folder of its kernel cache.
    """
    sys.stderr.flush()
    with tempfile.TemporaryFile() as said:
        kept = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        for line in said.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                print(line, file=sys.stderr)
