"""Compilation of kernels (Numba), with a cache on disk that may be missing: without it each start compiles again.

Numba refuses to decorate a function where it finds no folder to write to (a read-only installation and home), and a
disk that is full or has lost a cached file would end the first call.
"""

import logging
import pickle
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys

log = logging.getLogger(__name__)

Kernel = TypeVar("Kernel", bound=Callable[..., Any])
Array = TypeVar("Array", bound=np.ndarray)
# Versions of Numba whose cached code was tried without its compiler, whose tables take a third of a second to prepare.
WITHOUT_COMPILER = "0.68."
_njit = numba.njit(nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")
_LOST = (OSError, EOFError, ValueError, pickle.UnpicklingError)  # of a disk that refuses, or of an incomplete file


class _OptionalCache(FunctionCache):
    """Numba's cache of one function, whose files may be unreadable and need not be written."""

    def load_overload(self, sig: object, target_context: object) -> object:
        parent: Any = super()
        load = parent.load_overload
        if numba.__version__.startswith(WITHOUT_COMPILER):
            rtsys.initialize(target_context)  # allocates the arrays of kernels, and is all that compiled code needs
            load = parent._load_overload
        try:
            return load(sig, target_context)
        except _LOST as error:
            _report(f"{type(error).__name__}: {error}")
            return None

    def save_overload(self, sig: object, data: object) -> None:
        parent: Any = super()
        try:
            parent.save_overload(sig, data)
        except _LOST as error:
            _report(f"{type(error).__name__}: {error}")


def compiled(function: Kernel) -> Kernel:
    """Return a function that is compiled at its first call, or loaded from the cache if there is one."""
    made: Any = _njit(function)
    optional_cache: Any = _OptionalCache
    try:
        made._cache = optional_cache(function)  # as `enable_caching` of Numba does
    except RuntimeError:
        _report("no folder for it can be written; NUMBA_CACHE_DIR may name one")
    kernel: Kernel = made
    return kernel


def read_only(array: Array) -> Array:
    """Return a read-only view of an array; data are not copied.

    Read-only is part of an array's type in compiled code: a kernel would be compiled once for each kind.
    """
    view = array.view()
    view.flags.writeable = False
    return view


@cache
def _report(reason: str) -> None:
    """Log once that compiled code is not cached."""
    log.warning("compiled code is not cached, so each start takes some seconds longer: %s", reason)
