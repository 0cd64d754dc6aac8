"""A disk without space, by the system's limit of a file's size: needs no privilege, and the errors are the kernel's."""

import resource
from contextlib import contextmanager


@contextmanager
def files_up_to(size):
    """Let the system refuse to write beyond ``size`` bytes of any file."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
