"""The project's one way to compile a kernel: numba with a cache that can't go stale.

numba's own cache notices a change of the file that holds a kernel, but not of the files it calls into: after
an edit of ``vec.py`` every other kernel would still run the old code. So the cache folder is named after the
content of all kernel sources, and an edit anywhere starts a fresh one. Inside it a kernel is found by its module: a
copy of the project, such as an installed wheel, can use what another copy has compiled. The folder is beside the
sources of a working copy, else in the user's own cache. A damaged file of the cache is thrown away and made again, and
a cache that can't be written costs a compilation at each start: both are one line in the log, and so is compiling.
"""

import hashlib
import logging
import os
import pickle
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

log = logging.getLogger(__name__)

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])

_ROOT = Path(__file__).parents[1]
_FORMAT: Final = 2  # of the cache's files
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
    digest = hashlib.sha256(f"{numba.__version__} {_FORMAT}".encode())
    for path in sorted(path for folder in KERNEL_ROOMS for path in _ROOT.glob(f"{folder}/**/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def user_cache() -> list[Path]:
    """Return the user's folder for compiled kernels; none where the user has no home."""
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # no HOME, and no entry in the table of users
        return []
    return [cache / "topspin" / "numba"] if cache.is_absolute() else []


def writable_cache(candidates: list[Path]) -> Path | None:
    """Return the first folder that can be written, made if need be; None, with one line in the log: there is none."""
    for folder in candidates:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            return folder
    log.warning(
        "compiled kernels can't be kept, so every start compiles for a minute: no writable folder among %s",
        ", ".join(map(str, candidates)),
    )
    return None


class _DamagedError(Exception):
    """A file of the cache does not hold what was written."""


class _CheckedFiles(IndexDataCacheFile):
    """numba's files, with a checksum: damaged machine code would end the process without a word."""

    def _save_data(self, name: str, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(zlib.crc32(content).to_bytes(4, "big") + content)

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        if zlib.crc32(content[4:]).to_bytes(4, "big") != content[:4]:
            raise _DamagedError(f"checksum of {name}")
        return pickle.loads(content[4:])


class _KernelCache(FunctionCache):
    """numba's cache of one kernel; its files may be damaged or unwritable, and the kernel is compiled then."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp: Any = self._impl.locator.get_source_stamp()
        if room := _room_of(function):
            self._cache_path = str(Path(numba.config.CACHE_DIR) / room)  # type: ignore[attr-defined]
            stamp = _FORMAT  # the folder's name says which sources: a copy has other paths and times
        self._cache_file = _CheckedFiles(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=stamp
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled kernel for a signature; None where it has to be compiled, which is said once."""
        try:
            found = super().load_overload(sig, target_context)
        except Exception as error:  # whatever damaged content makes pickle raise
            _say_once("damaged files of the kernel cache are thrown away and made again", error)
            self._throw_away()
            return None
        if found is None:
            _say_that_it_compiles()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel, where that is possible."""
        try:
            Path(self._cache_path).mkdir(parents=True, exist_ok=True)
            super().save_overload(sig, data)
        except Exception as error:  # a full disk, or an index that was damaged meanwhile
            _say_once(_NOT_KEPT, error)

    def _throw_away(self) -> None:
        """Remove the index: the files that it names are written again."""
        index = Path(self._cache_file._index_path)
        try:
            shutil.rmtree(index) if index.is_dir() else index.unlink(missing_ok=True)
        except OSError as error:
            _say_once(_NOT_KEPT, error)


def _room_of(function: Callable[..., Any]) -> str:
    """Return the dotted folder of a kernel whose source names the cache; "" for a kernel of another file."""
    folder = Path(function.__code__.co_filename).parent
    if not folder.is_relative_to(_ROOT):
        return ""
    relative = folder.relative_to(_ROOT).as_posix()
    is_named = any(f"{relative}/".startswith(f"{room}/") for room in KERNEL_ROOMS)
    return relative.replace("/", ".") if is_named else ""


_NOT_KEPT: Final = "compiled kernels can't be kept, so every start compiles"
_COMPILES: Final = "compiling kernels: all of them take one to three minutes, once for each version"
_said: set[tuple[str, str]] = set()


def _say_that_it_compiles() -> None:
    """Log that this process compiles, before the first kernel: a start that is silent for minutes looks dead."""
    if _is_new(_COMPILES):
        log.info("%s folder=%s", _COMPILES, numba.config.CACHE_DIR)  # type: ignore[attr-defined]


def _say_once(what: str, error: Exception) -> None:
    """Log what is wrong with the cache: one line, however many kernels there are."""
    if _is_new(what):
        folder: str = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        log.warning("%s folder=%s reason=%s: %s", what, folder, type(error).__name__, error)


def _is_new(what: str) -> bool:
    """Return whether this has not been said of the cache folder yet; it counts as said from now on."""
    said = (str(numba.config.CACHE_DIR), what)  # type: ignore[attr-defined]
    if said in _said:
        return False
    _said.add(said)
    return True


def seed_cache(folder: Path, prebuilt: Path) -> None:
    """Copy the kernels that came with a read-only install into the user's ``folder``, unless it exists."""
    if folder.exists() or not prebuilt.is_dir():
        return
    part = folder.with_name(f".{folder.name}-{os.getpid()}")
    try:
        shutil.copytree(prebuilt, part, copy_function=shutil.copyfile)
        part.rename(folder)
    except OSError as error:  # another process was first, or the disk is full: what is missing is compiled
        log.info("kernels not copied from=%s to=%s reason=%s", prebuilt, folder, error)
    shutil.rmtree(part, ignore_errors=True)


def _folder_of_kernels() -> Path | None:
    """Return this release's folder of kernels; None where they can't be kept."""
    own, installed = os.environ.get("NUMBA_CACHE_DIR"), _ROOT / ".numba_cache"
    is_working_copy = (_ROOT / "pyproject.toml").is_file()  # nothing is written beside installed packages
    others = [installed, *user_cache()] if is_working_copy else [*user_cache(), installed]
    folder = writable_cache([*([Path(own)] if own else []), *others])
    if folder is None:
        return None
    digest = _source_digest()
    if folder != installed:
        seed_cache(folder / digest, installed / digest)
    return folder / digest


_folder = _folder_of_kernels()
# numba makes its settings attributes when it is imported
numba.config.CACHE_DIR = str(_folder or "")  # type: ignore[attr-defined]


def _compiled(function: _Kernel, **options: Any) -> _Kernel:
    compiled: Any = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if _folder is not None:
        compiled._cache = _KernelCache(function)
    return cast(_Kernel, compiled)


def kernel(function: _Kernel) -> _Kernel:
    """Return ``function`` compiled: cached, GIL released, no fastmath: equal inputs give equal bits."""
    return _compiled(function)


def inlined(function: _Kernel) -> _Kernel:
    """Return ``function`` compiled into the kernels that call it, for the parts of a control step.

    A call that passes ``Rallies`` passes twenty arrays and counts their references: 0.2 us a rally and call. Inlined,
    the parts of a step cost 20 % less. Where a kernel has many such calls, only those on every step's way are inlined,
    because each one lengthens the compilation.
    """
    return _compiled(function, forceinline=True)
