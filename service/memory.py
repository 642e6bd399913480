"""The C library's allocator, told to keep buffers of a picture's size.

By default glibc gives them back to the system after every request, and the page faults of taking them anew were a third
of the time of all but the graphs.
"""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES = 64 * 2**20
LARGEST_KEPT_BYTES = 16 * 2**20


def keep_freed_memory() -> None:
    """Keep up to ``KEPT_BYTES`` an arena that are free, in blocks up to ``LARGEST_KEPT_BYTES``; glibc alone can."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
