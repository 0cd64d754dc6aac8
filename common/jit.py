"""The project's one way to compile a kernel: numba with a cache that can't go stale.

numba's own cache notices a change of the file that holds a kernel, but not of the files it calls into: after
an edit of ``vec.py`` every other kernel would still run the old code. So the cache folder is named after the
content of all kernel sources, and an edit anywhere starts a fresh one. It is beside the sources, or in the user's own
cache where the sources belong to someone else.
"""

import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba

log = logging.getLogger(__name__)

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])

_ROOT = Path(__file__).parents[1]
KERNEL_ROOMS: Final = (
    "common/physics",
    "common/task",
    "common/perception",
    "common/policy",
    "common/rally",
    "common/env",
    "common/evaluation",
    "topspin/real2sim",
)
"""Folders with kernels; a test finds every ``@kernel`` and checks that its folder is here."""


def _source_digest() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(path for folder in KERNEL_ROOMS for path in _ROOT.glob(f"{folder}/**/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def user_cache() -> list[Path]:
    """Return the user's folder for compiled kernels; none where the user has no home."""
    try:
        return [Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "topspin" / "numba"]
    except RuntimeError:  # no HOME, and no entry in the table of users
        return []


def writable_cache(candidates: list[Path]) -> Path | None:
    """Return the first folder that can be written, made if need be; None, with one line in the log: there is none."""
    for folder in candidates:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    log.warning(
        "compiled kernels can't be kept, so every start compiles for a minute: no writable folder among %s",
        ", ".join(map(str, candidates)),
    )
    return None


_keeps = True
if "NUMBA_CACHE_DIR" not in os.environ:
    _folder = writable_cache([_ROOT / ".numba_cache", *user_cache()])
    _keeps = _folder is not None
    if _folder is not None:
        # numba makes its settings attributes when it is imported
        numba.config.CACHE_DIR = str(_folder / _source_digest())  # type: ignore[attr-defined]


def kernel(function: _Kernel) -> _Kernel:
    """Return ``function`` compiled: cached, GIL released, no fastmath: equal inputs give equal bits."""
    compiled: Any = numba.njit(cache=_keeps, nogil=True, error_model="numpy")(function)
    return cast(_Kernel, compiled)


def inlined(function: _Kernel) -> _Kernel:
    """Return ``function`` compiled into the kernels that call it, for the parts of a control step.

    A call that passes ``Rallies`` passes twenty arrays and counts their references: 0.2 us a rally and call. Inlined,
    the parts of a step cost 20 % less. Where a kernel has many such calls, only those on every step's way are inlined,
    because each one lengthens the compilation.
    """
    compiled: Any = numba.njit(cache=_keeps, nogil=True, error_model="numpy", forceinline=True)(function)
    return cast(_Kernel, compiled)
