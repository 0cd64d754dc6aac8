"""The folders whose content names the kernels' cache: every folder with a kernel is one of them."""

import importlib.util
import logging
import re
from pathlib import Path

import numba
import pytest

from common.jit import KERNEL_ROOMS, seed_cache, user_cache, writable_cache
from tests.full_disk import files_up_to

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


KERNEL_FILE = "from common.jit import kernel\n\n\n@kernel\ndef twice(x):\n    return 2.0 * x\n"


def twice(folder):
    """Return the kernel of a file in ``folder``, as a process that just starts has it."""
    file = folder / "module.py"
    file.write_text(KERNEL_FILE)
    spec = importlib.util.spec_from_file_location("module", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.twice


def was_kept(found):
    return sum(found.stats.cache_hits.values()) == 1


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def flip(file, at):
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)


def as_folder(file):
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(file.read_bytes()[:-20]),
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(b"rubbish"),
        lambda file: flip(file, -200),
        as_folder,
    ],
    ids=["truncated", "empty", "rubbish", "flipped", "folder"],
)
def test_a_damaged_file_of_the_cache_is_thrown_away_and_made_again(tmp_path, cache, caplog, kind, damage):
    assert twice(tmp_path)(1.5) == 3.0
    (file,) = cache.rglob(f"*.{kind}")
    damage(file)
    with caplog.at_level(logging.WARNING):
        assert twice(tmp_path)(1.5) == 3.0
    again = twice(tmp_path)

    assert again(1.5) == 3.0
    assert len(caplog.records) <= 1
    assert all(re.search("are thrown away and made again|can't be kept", line) for line in caplog.messages)
    assert was_kept(again) or file.is_dir()


def test_where_the_disk_is_full_kernels_run_and_one_line_says_that_they_are_not_kept(tmp_path, cache, caplog):
    found = twice(tmp_path)
    with caplog.at_level(logging.WARNING), files_up_to(0):
        assert found(1.5) == 3.0
        assert found(2) == 4.0

    assert [message.split(" folder=")[0] for message in caplog.messages] == [
        "compiled kernels can't be kept, so every start compiles"
    ]


def test_a_process_says_once_that_it_compiles(tmp_path, cache, caplog):
    found = twice(tmp_path)
    with caplog.at_level(logging.INFO):
        assert found(1.5) == 3.0
        assert found(2) == 4.0

    assert [message.split(":")[0] for message in caplog.messages] == ["compiling kernels"]


def test_kernels_that_are_in_the_cache_are_used_without_a_word(tmp_path, cache, caplog):
    twice(tmp_path)(1.5)
    caplog.clear()
    with caplog.at_level(logging.INFO):
        assert twice(tmp_path)(1.5) == 3.0

    assert caplog.messages == []


def test_kernels_that_came_with_a_read_only_install_are_copied_once(tmp_path):
    (tmp_path / "installed" / "module_1").mkdir(parents=True)
    (tmp_path / "installed" / "module_1" / "k.nbi").write_text("kernel")
    (tmp_path / "installed" / "module_1" / "k.nbi").chmod(0o444)
    mine = tmp_path / "mine" / "digest"
    mine.parent.mkdir()
    seed_cache(mine, tmp_path / "installed")
    (mine / "module_1" / "k.nbi").write_text("newer")
    seed_cache(mine, tmp_path / "installed")
    seed_cache(tmp_path / "mine" / "other", tmp_path / "missing")

    assert (mine / "module_1" / "k.nbi").read_text() == "newer"
    assert [path.name for path in mine.parent.iterdir()] == ["digest"]


def test_a_home_that_is_no_folder_of_ones_own_is_not_used(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "here")

    assert user_cache() == []
