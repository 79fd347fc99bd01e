"""Settings of glibc's allocator: freed arrays go back to the system, and all threads share two heaps.

By default glibc raises its limit for separately mapped memory with every array that is freed, up to 32 MB. From then on
frames and spectra lie in the heaps between small objects, and their memory stays with the process after their end; each
thread has a heap of its own.
"""

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8  # the parameters of `mallopt` in malloc.h
MAPPED_BYTES = 4_000_000  # counts of 2 MP take 4.1 MB; grids of samples less, and are used again within the heaps


def return_freed_arrays() -> None:
    """Map each array of MAPPED_BYTES or more separately, with fixed limits; no-op where the C library is not glibc."""
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        for option, value in ((MMAP_THRESHOLD, MAPPED_BYTES), (TRIM_THRESHOLD, MAPPED_BYTES), (ARENA_MAX, 2)):
            set_option(option, value)
