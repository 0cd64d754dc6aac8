"""Writing files that survive a crash and a power cut."""

import os
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile


def write_whole(file: Path, content: str | bytes) -> None:
    """Replace a file in one step; after a crash or a power cut it holds the old content or the new one.

    Raises:
        OSError: It can't be written, such as on a full disk; the old one is as it was.
    """
    part = file.with_name(f"{file.name}.part")
    try:
        with part.open("wb") as out:
            out.write(content.encode() if isinstance(content, str) else content)
            out.flush()
            os.fsync(out.fileno())
        os.replace(part, file)
    except OSError:
        with suppress(OSError):
            part.unlink()
        raise
    sync_folder(file.parent)


def make_writable(folder: Path) -> None:
    """Make a folder unless it is there. Raises OSError if no file can be written in it: ask before hours of work."""
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryFile(dir=folder):
        pass


def sync_folder(folder: Path) -> None:
    """Make the names in a folder survive a power cut, where the file system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
