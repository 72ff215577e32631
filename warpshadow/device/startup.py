"""Starting Warp without what it says as it starts."""

import os
import sys
import tempfile

import warp as wp

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def start_quietly() -> None:
    """Start Warp, and keep its remark that a machine has no GPU, which its native code prints, off the terminal.

    What else it prints on stderr meanwhile is printed after.
    """
    sys.stderr.flush()
    with tempfile.TemporaryFile() as caught:
        terminal = os.dup(2)
        try:
            os.dup2(caught.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(terminal, 2)
                caught.seek(0)
                for line in caught:
                    if _NO_DRIVER not in line:
                        os.write(2, line)
        finally:
            os.close(terminal)
