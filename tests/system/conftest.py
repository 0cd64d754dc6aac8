import pytest

from tests.system.commands import processes_in


@pytest.fixture(autouse=True)
def nothing_left_behind(tmp_path):
    """After a test, no process that names its folder is alive."""
    yield
    left = processes_in(tmp_path)
    for process in left:
        process.kill()
    assert not left, f"left behind: {[' '.join(process.cmdline()) for process in left]}"
