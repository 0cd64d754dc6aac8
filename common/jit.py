"""The project's one way to compile a kernel: numba with a cache that can't go stale.

numba's own cache notices a change of the file that holds a kernel, but not of the files it calls into: after
an edit of ``vec.py`` every other kernel would still run the old code. So the cache folder is named after the
content of all kernel sources, and an edit anywhere starts a fresh one.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])

_COMMON = Path(__file__).parent


def _source_digest() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted([*_COMMON.glob("physics/*.py"), *_COMMON.glob("rally/*.py"), *_COMMON.glob("env/*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


if "NUMBA_CACHE_DIR" not in os.environ:
    numba.config.CACHE_DIR = str(_COMMON.parent / ".numba_cache" / _source_digest())


def kernel(function: _Kernel) -> _Kernel:
    """Return ``function`` compiled: cached, GIL released, IEEE arithmetic (no fastmath: equal inputs, equal bits)."""
    compiled: _Kernel = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled
