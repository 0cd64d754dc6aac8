"""A process killed at every system call that changes files, by ptrace: what a crash can leave behind."""

import ctypes
import os
import platform
import signal
import struct

import pytest

TRACEME, SYSCALL, SETOPTIONS, GET_SYSCALL_INFO = 0, 24, 0x4200, 0x420E
TRACESYSGOOD, EXITKILL = 1, 0x100000
ENTRY = 1  # of ptrace_syscall_info: a call begins
NUMBER_AT = 24  # bytes before the call's number in it

# write, open, truncate, ftruncate, rename, mkdir, rmdir, link, unlink, symlink, chmod, fchmod, pwrite64, fsync,
# fdatasync, openat, mkdirat, unlinkat, renameat, linkat, symlinkat, fchmodat, renameat2, writev
CHANGING = {
    "x86_64": {
        1,
        2,
        76,
        77,
        82,
        83,
        84,
        86,
        87,
        88,
        90,
        91,
        18,
        74,
        75,
        257,
        258,
        263,
        264,
        265,
        266,
        268,
        316,
        20,
    },
    "aarch64": {64, 45, 46, 34, 35, 37, 36, 38, 52, 53, 68, 82, 83, 56, 276, 66},
}

_libc = ctypes.CDLL(None, use_errno=True)
_libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
_libc.ptrace.restype = ctypes.c_long


def killed_at_each_call(act, prepare):
    """Yield after each death of a process that runs ``act()``: at its first call that changes files, its second, ...

    Args:
        act: What the process does; it must not start threads.
        prepare: Called before each; puts the files back.

    Yields:
        The number of the call at which it was killed. The last one is that at which it was not: it was done.
    """
    if platform.system() != "Linux" or platform.machine() not in CHANGING:
        pytest.skip(
            f"needs Linux on {' or '.join(CHANGING)}; this is {platform.system()} {platform.machine()}"
        )
    number, is_done = 0, False
    while not is_done:
        prepare()
        is_done = not _killed(act, number)
        yield number
        number += 1


def _killed(act, number):
    """Return whether a process that runs ``act()`` was killed before its call ``number`` of those that change files."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            _libc.ptrace(TRACEME, 0, None, None)
            os.kill(os.getpid(), signal.SIGSTOP)
            act()
            status = 0
        finally:
            os._exit(status)
    os.waitpid(child, 0)
    if _libc.ptrace(SETOPTIONS, child, None, TRACESYSGOOD | EXITKILL):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        pytest.skip(f"no ptrace here: {os.strerror(ctypes.get_errno())}")
    calls = 0
    while True:
        _libc.ptrace(SYSCALL, child, None, None)
        _, status = os.waitpid(child, 0)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0, "the process failed by itself"
            return False
        if os.WIFSIGNALED(status) or os.WSTOPSIG(status) != signal.SIGTRAP | 0x80:
            continue
        if _call(child) in CHANGING[platform.machine()]:
            if calls == number:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return True
            calls += 1


def _call(child):
    """Return the number of the system call that begins, or -1 at the end of one."""
    info = ctypes.create_string_buffer(96)
    _libc.ptrace(GET_SYSCALL_INFO, child, ctypes.c_void_p(len(info)), info)
    return struct.unpack_from("Q", info, NUMBER_AT)[0] if info[0][0] == ENTRY else -1
