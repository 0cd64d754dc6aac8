"""A file system without links, by a filter of system calls in a child process: the errors are the kernel's."""

import ctypes
import errno
import platform
import struct

import pytest

PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, FILTER = 38, 22, 2
ALLOW, ERRNO = 0x7FFF0000, 0x00050000
LOAD, JUMP_IF_EQUAL, RETURN = 0x20, 0x15, 0x06
LINKING = {"x86_64": (86, 88, 265, 266), "aarch64": (36, 37)}  # link, symlink, linkat, symlinkat


class _Program(ctypes.Structure):
    _fields_ = (("count", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def skip_without_filter():
    """Skip the test where the numbers of the calls are not known."""
    if platform.system() != "Linux" or platform.machine() not in LINKING:
        pytest.skip(f"needs Linux on {' or '.join(LINKING)}")


def refuse_links():
    """Let the kernel refuse every new link to this process and its children, as exFAT does: EPERM."""
    calls = LINKING[platform.machine()]
    code = [(LOAD, 0, 0, 0)]
    code += [(JUMP_IF_EQUAL, len(calls) - k, 0, number) for k, number in enumerate(calls)]
    code += [(RETURN, 0, 0, ALLOW), (RETURN, 0, 0, ERRNO | errno.EPERM)]
    program = _Program(len(code), b"".join(struct.pack("HBBI", *each) for each in code))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or libc.prctl(
        PR_SET_SECCOMP, FILTER, ctypes.byref(program)
    ):
        raise OSError(ctypes.get_errno(), "prctl")
