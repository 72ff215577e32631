"""torch on one thread while a fit runs, so that it is the same to the bit on any number of cores."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let torch compute on the calling thread alone: its sums depend on how many threads share them.

    Kernels keep their threads, on which results do not depend.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)
