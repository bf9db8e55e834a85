"""Whether numba has compiled the kernels before, on this machine and in this version."""
from __future__ import annotations

from collections.abc import Callable

from numba import njit

COMPILING = 'compiling the numerical kernels for this machine, once: this takes a minute or so'


@njit(cache=True, nogil=True)
def _probe():
    """As good as any kernel to see whether the cache is filled."""
    return 0


def cache_is_empty(tell: Callable[[str], None]) -> bool:
    """True, and told, the first time in a process that finds nothing compiled."""
    missing = _probe.stats.cache_misses.total()
    _probe()
    empty = _probe.stats.cache_misses.total() > missing
    if empty:
        tell(COMPILING)
    return empty
