"""Whether numba has compiled the kernels before, on this machine and in this version."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from numba import njit

COMPILING = 'compiling the numerical kernels for this machine, once: this takes a minute or so'


@njit(cache=True, nogil=True)
def fill():
    """Called when every kernel has been: where this one is in the cache, so are the others."""


def cache_is_empty(tell: Callable[[str], None]) -> bool:
    """True, and told, until a start has compiled everything."""
    source = Path(__file__)
    indices = Path(fill.stats.cache_path).glob(f'{source.stem}.fill-*.nbi')
    if any(index.stat().st_mtime >= source.stat().st_mtime for index in indices):
        return False
    tell(COMPILING)
    return True
