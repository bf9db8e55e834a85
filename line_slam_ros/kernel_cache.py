"""How kernels are compiled, and whether they have been before, on this machine and in this version."""
from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

# read by numba once: level 3 takes a quarter longer and gains nothing here, and of the errors that finding the types of
# anything goes through, none is shown
os.environ.setdefault('NUMBA_OPT', '2')
os.environ.setdefault('NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING', '1')

from numba import njit
from numba.extending import register_jitable

COMPILING = 'compiling the numerical kernels for this machine, once: this takes a minute or so'


def kernel(function: Any = None, **options: Any) -> Any:
    """Decorator: compiled when called first, kept on disk, without the GIL. No C function: nobody takes its address."""
    return njit(function, cache=True, nogil=True, error_model='numpy', no_cfunc_wrapper=True, **options)


def inner(function: Any = None, **options: Any) -> Any:
    """Decorator of what only kernels call: compiled into them, one version whatever constants they pass.

    Half as long to compile as a kernel, but twice if kernels and inner ones call it: what is long and called by both is
    better a kernel. Called from Python it stays Python.
    """
    decorate = register_jitable(error_model='numpy', no_cfunc_wrapper=True, **options)
    return decorate(function) if function else decorate


@kernel
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
