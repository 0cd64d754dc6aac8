import os
import signal
import subprocess
import sys

import pytest

from common.run_folder import RunAliveError, RunFolder, whole_rows

HOLD = """
import subprocess, sys, time
from pathlib import Path
from common.run_folder import RunFolder
with RunFolder(Path(sys.argv[1])).held_by("learner"):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    print(child.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("half", ["200,0.", "200", "200\n", "200,0.5,1\n"])
def test_half_a_line_is_left_for_later(tmp_path, half):
    path = tmp_path / "evaluations.csv"
    assert whole_rows(path) == []
    path.write_text(f"frames,return_rate\n100,0.5\n{half}")

    assert [row["frames"] for row in whole_rows(path)] == ["100"]


def test_a_folder_has_one_learner_at_a_time_and_the_second_is_told_its_process(tmp_path):
    folder = RunFolder(tmp_path / "r")
    with folder.held_by("learner"):
        for try_it in (
            lambda: folder.held_by("learner").__enter__(),
            lambda: folder.check_free_of("learner"),
        ):
            with pytest.raises(
                RunAliveError, match=f"run 'r' is alive: learner, process {os.getpid()}, is at work"
            ):
                try_it()

    folder.check_free_of("learner")
    with folder.held_by("learner"):
        pass


def test_the_learner_that_a_run_starts_is_not_kept_out_by_the_run(tmp_path):
    folder = RunFolder(tmp_path / "r")
    with folder.held_by("deploy.local"):
        folder.check_free_of("learner")
        with folder.held_by("learner"):
            pass


def test_whether_a_folder_is_free_is_found_out_without_making_it(tmp_path):
    RunFolder(tmp_path / "r").check_free_of("learner")

    assert not (tmp_path / "r").exists()


def test_a_process_that_is_killed_leaves_its_folder_free_though_what_it_started_lives_on(tmp_path):
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
