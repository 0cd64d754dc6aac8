"""The programs in examples/, run as their first lines say."""

import subprocess
import sys
from pathlib import Path

from tests.system.commands import STAGES, TINY, running
from tests.waiting import wait_until

ROOT = Path(__file__).parents[2]


def example(folder, name, *arguments):
    return subprocess.run(
        [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": "", "HOME": str(folder)},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )


def test_a_run_is_watched(tmp_path):
    names = ["learner-0", "evaluator-0", "generator-0", "actor-0", "actor-1"]

    def is_ready():
        done = example(tmp_path, "watch_run.py", "r")
        return done.returncode == 0 and all(f"{name}  ready" in done.stdout for name in names)

    assert "topspin train writes it" in example(tmp_path, "watch_run.py", "r").stderr
    with running(
        tmp_path, "deploy.local", "--run", "r", *TINY, *STAGES, "--learner.curriculum.stage-3", 10**9
    ):
        wait_until(is_ready, 60, "all services to be ready")
        rows = example(tmp_path, "watch_run.py", "r").stdout.splitlines()

    assert sorted(row.split()[0] for row in rows) == sorted(names)
    assert all("frames_total" in row for row in rows if "learner" in row or "actor" in row)
    assert all("ready" in row for row in rows)
    # It was killed, and its services end when they notice it
    wait_until(lambda: example(tmp_path, "watch_run.py", "r").returncode == 1, 60, "all services to be gone")


def test_the_papers_recipe_is_trained_measured_and_compared(tmp_path):
    tiny = [flag for flag in TINY if flag not in ("--panel", "off")]
    tiny = tiny[: tiny.index("--network.units")] + tiny[tiny.index("--network.units") + 2 :]
    flags = ("--seeds", 1, "--frames", 2000, "--rallies", 20, *tiny, "--panel", "off")

    done = example(tmp_path, "reproduce_paper.py", *flags)
    again = example(tmp_path, "reproduce_paper.py", *flags)

    assert done.returncode == 0, done.stderr[-500:]
    header, *rows = done.stdout.splitlines()
    assert header.split() == ["paper", "median", "by", "seed"]
    assert [row.split()[:2] for row in rows] == [
        ["return_rate", "0.81"],
        ["return_after_catch", "0.90"],
        ["target_error_mean", "0.31"],
    ]
    assert again.stdout == done.stdout
