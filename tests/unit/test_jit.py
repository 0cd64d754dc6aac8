"""The folders whose content names the kernels' cache: every folder with a kernel is one of them."""

import re
from pathlib import Path

import pytest

from common.jit import KERNEL_ROOMS, writable_cache

ROOT = Path(__file__).parents[2]
PACKAGES = ("common", "services", "deploy", "topspin")
KERNEL = re.compile(
    r"^@(kernel|inlined)\b|\bkernel\(|^from common\.jit import .*\b(kernel|inlined)\b", re.MULTILINE
)


def files_with_kernels() -> list[str]:
    """Return the files of the packages that compile kernels, without ``common/jit.py`` itself."""
    files = (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")))
    return [
        path.relative_to(ROOT).as_posix()
        for path in files
        if path != ROOT / "common" / "jit.py" and KERNEL.search(path.read_text())
    ]


def test_every_file_with_a_kernel_is_in_a_folder_that_names_the_cache():
    files = files_with_kernels()
    missing = [file for file in files if not any(file.startswith(f"{room}/") for room in KERNEL_ROOMS)]

    assert len(files) > 20
    assert missing == []


@pytest.mark.parametrize("room", KERNEL_ROOMS)
def test_every_folder_that_names_the_cache_has_a_kernel(room):
    assert any(file.startswith(f"{room}/") for file in files_with_kernels())


def test_kernels_are_kept_in_the_first_folder_that_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    blocked, first, second = tmp_path / "file" / "cache", tmp_path / "a" / "cache", tmp_path / "b"

    assert writable_cache([blocked, first, second]) == first
    assert first.is_dir()
    assert not second.exists()


def test_where_kernels_cannot_be_kept_one_line_says_so(tmp_path, caplog):
    (tmp_path / "file").touch()

    assert writable_cache([tmp_path / "file" / "cache"]) is None
    assert "every start compiles" in caplog.text
    assert len(caplog.records) == 1
