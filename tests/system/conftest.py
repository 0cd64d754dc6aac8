import sys
from pathlib import Path

import pytest

# The builders beside these tests: with import-mode importlib a folder of tests is no package.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def nothing_left_behind(tmp_path):
    """Whatever a test started, no process that names its folder survives it."""
    from commands import processes_in

    yield
    left = processes_in(tmp_path)
    for process in left:
        process.kill()
    assert not left, f"left behind: {[' '.join(process.cmdline()) for process in left]}"
