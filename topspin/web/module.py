"""The kernels of the ball as a WebAssembly module, compiled once and kept."""

import fcntl
import hashlib
import logging
from pathlib import Path
from typing import Final

import llvmlite  # type: ignore[import-untyped]
import numba

from common.env.robot import RobotBatch
from common.service.whole_file import write_whole
from common.task.config import TaskConfig
from topspin.web import entry, values, wasm

log = logging.getLogger(__name__)

_SOURCES: Final = (entry, values, wasm)


def ball_module() -> bytes:
    """Return the module; compiling it takes half a minute, once for each change of the kernels' sources.

    It is kept beside the compiled kernels, whose folder is named after the content of all their sources.
    """
    kept = _kept()
    if kept is None:
        return _compiled()
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        with kept.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # a second process waits for the first one's module
            if not kept.is_file():
                write_whole(kept, _compiled())
        return kept.read_bytes()
    except OSError as error:
        log.warning("the kernels for browsers can't be kept in %s: %s", kept.parent, error.strerror)
        return _compiled()


def _compiled() -> bytes:
    log.info("compiling the kernels for browsers: about half a minute, once")
    task = TaskConfig()  # any: the module is the same for all
    example = values.values_of(task, RobotBatch(1, task.robot, task.control_rate_hz))
    return wasm.compiled(entry.entry_ir(example))


def _kept() -> Path | None:
    """Return where the module is kept; None where compiled kernels can't be kept."""
    folder: str = numba.config.CACHE_DIR  # type: ignore[attr-defined]  # common.jit names it after all kernels
    if not folder:
        return None
    digest = hashlib.sha256(llvmlite.__version__.encode())
    for module in _SOURCES:
        digest.update(Path(module.__file__ or "").read_bytes())
    return Path(folder) / "topspin.web" / f"{digest.hexdigest()[:16]}.wasm"
