"""What is done about memory: the C library's allocator keeps buffers of a picture's size, and Python's collector leaves
alone what lasts.

By default glibc gives buffers back to the system after every request, and the page faults of taking them anew were a
third of the time of all but the graphs. By default Python looks through the 175,000 objects that a service is made of
while they are made, whenever they have grown by a quarter, and once more before it ends: 1 s of 3.4 from start to end.
"""

import atexit
import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES = 64 * 2**20
LARGEST_KEPT_BYTES = 16 * 2**20


def keep_freed_memory() -> None:
    """Keep up to ``KEPT_BYTES`` of freed memory an arena, in blocks up to ``LARGEST_KEPT_BYTES``; glibc alone can."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


@contextmanager
def lasting() -> Iterator[None]:
    """What is made within lives as long as the process: nobody looks for garbage in it, then or later."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def end_uncollected() -> None:
    """Let the process end without a look for garbage, which goes with it."""
    atexit.register(gc.freeze)
