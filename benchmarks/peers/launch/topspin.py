"""Ours, as a user starts it: `topspin train`, with two actors, in stage 1 all the time.

The evaluator is off, since no peer has one. Policies are those that the learner saves, every ten seconds.
"""

import os
import shutil
import signal
import subprocess
import sys
import time

from benchmarks.peers import task
from benchmarks.peers.trainers import PROJECT
from common.service.run_folder import RunFolder
from deploy.prepare import last_epoch

RUN = "peers"
LOOK_S = 0.25
PATIENCE_S = 60.0


def main() -> None:
    """Train, and keep what the run writes."""
    asked = task.order()
    options = {
        **{"run": RUN, "actors": task.CORES, "panel": "off", "metrics-port": 0, "evaluate": "false"},
        **{"seed": asked.seed, "learner.curriculum.stage-1": 10**9},
        **{"learner.checkpoint-interval-s": task.SNAPSHOT_S},
    }
    flags = [f"--{name}={value}" for name, value in options.items()]
    training = subprocess.Popen(
        [sys.executable, "-m", "topspin", "train", *flags],
        cwd=asked.folder,
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        stdin=subprocess.DEVNULL,
    )
    run = RunFolder.of(RUN, str(asked.folder / "runs" / RUN))
    frames, saved = 0, 0.0
    weights = run.latest_policy / "weights.safetensors"
    with (asked.folder / task.PROGRESS).open("w", encoding="utf-8") as progress:
        is_over = False
        while training.poll() is None:
            seconds = time.time() - asked.started
            if not is_over and seconds >= asked.seconds:
                is_over = True
                training.send_signal(signal.SIGINT)
            newest = int(last_epoch(run).get("frames", 0))
            if newest > frames and not is_over:
                frames = newest
                progress.write(f"{seconds:.3f},{frames}\n")
                progress.flush()
            written = weights.stat().st_mtime if weights.exists() else 0.0
            if frames and written > saved:
                saved = written
                shutil.copytree(run.latest_policy, asked.folder / f"{written - asked.started:.1f}-{frames}")
            time.sleep(LOOK_S)
    if frames and weights.exists() and weights.stat().st_mtime > saved:
        seconds = weights.stat().st_mtime - asked.started
        shutil.copytree(run.latest_policy, asked.folder / f"{seconds:.1f}-{frames}")


if __name__ == "__main__":
    main()
