"""Start Warp without its start-up messages."""

import os
import sys

import warp as wp

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def start_quietly() -> None:
    """Start Warp without its messages, and keep its remark that a machine has no GPU, which its native code prints, off
    the terminal.

    Warnings stay. Other output on stderr is held back and printed afterwards.
    """
    wp.config.log_level = getattr(wp, "LOG_WARNING", 30)
    wp.config.quiet = True  # releases before log_level read this
    if sys.stderr is None:  # as of a service
        wp.init()
        return
    sys.stderr.flush()
    terminal = os.dup(2)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)  # should it be full, the rest is lost: there is no reader while Warp starts
    try:
        os.dup2(writer, 2)
        wp.init()
    finally:
        os.dup2(terminal, 2)
        for item in (terminal, writer):
            os.close(item)
        with open(reader, "rb") as caught:
            for line in caught:
                if _NO_DRIVER not in line:
                    os.write(2, line)
