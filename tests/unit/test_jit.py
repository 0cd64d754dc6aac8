"""The folders whose content names the kernels' cache: every folder with a kernel is one of them."""

import re
from pathlib import Path

import pytest

from common.jit import KERNEL_ROOMS

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
