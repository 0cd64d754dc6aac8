import os
import signal
import subprocess
import sys

import pytest

from common.service.run_folder import RunAliveError, RunFolder
from common.service.table import whole_rows

HOLD = """
import subprocess, sys, time
from pathlib import Path
from common.service.run_folder import RunFolder
with RunFolder(Path(sys.argv[1])).held_by("learner"):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    print(child.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("half", ["200,0.", "200", "200\n", "200,0.5,1\n"])
def test_an_incomplete_line_is_left_out(tmp_path, half):
    path = tmp_path / "evaluations.csv"
    assert whole_rows(path) == []
    path.write_text(f"frames,return_rate\n100,0.5\n{half}")

    assert [row["frames"] for row in whole_rows(path)] == ["100"]


def test_a_folder_has_one_learner_at_a_time_and_the_second_gets_its_process_id(tmp_path):
    folder = RunFolder(tmp_path / "r")
    with folder.held_by("learner"):
        for try_it in (
            lambda: folder.held_by("learner").__enter__(),
            lambda: folder.check_free_of("learner"),
        ):
            with pytest.raises(
                RunAliveError, match=f"run 'r' is alive: learner, process {os.getpid()}, uses"
            ):
                try_it()

    folder.check_free_of("learner")
    with folder.held_by("learner"):
        pass


def test_a_run_does_not_lock_out_its_own_learner(tmp_path):
    folder = RunFolder(tmp_path / "r")
    with folder.held_by("deploy.local"):
        folder.check_free_of("learner")
        with folder.held_by("learner"):
            pass


def test_the_check_for_a_free_folder_does_not_create_it(tmp_path):
    RunFolder(tmp_path / "r").check_free_of("learner")

    assert not (tmp_path / "r").exists()


def test_a_killed_process_frees_its_folder_even_if_its_child_lives_on(tmp_path):
    folder = RunFolder(tmp_path / "r")
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder.root)], stdout=subprocess.PIPE, text=True
    ) as process:
        child = int(process.stdout.readline())
        with pytest.raises(RunAliveError, match=f"process {process.pid}, "):
            folder.check_free_of("learner")
        process.kill()
        process.wait(20)
        try:
            folder.check_free_of("learner")
        finally:
            os.kill(child, signal.SIGKILL)
