"""Two learners train together; when one dies the group starts again, and no rollout is unaccounted for."""

import json
import os
import signal
import urllib.request

import psutil

from common.service.table import whole_rows
from tests.system.commands import TINY, last_json, running
from tests.waiting import wait_until

FATES = ("trained", "refused", "dropped", "in_flight", "lost")


def test_a_group_of_learners_trains_dies_and_goes_on(tmp_path):
    folder = tmp_path / "runs/r"

    def trained():
        rows = whole_rows(folder / "metrics.csv")
        return int(rows[-1]["epoch"]) if rows else 0

    def update_seconds():
        """Return how long each learner's updates took, as its /metrics says."""
        groups = json.loads((folder / "targets.json").read_text())
        learners = {g["labels"]["id"]: g["targets"][0] for g in groups if g["labels"]["role"] == "learner"}
        found = {}
        for rank, address in learners.items():
            with urllib.request.urlopen(f"http://{address}/metrics") as answer:
                lines = answer.read().decode().splitlines()
            (line,) = [
                line for line in lines if line.startswith("topspin_phase_seconds_total") and "update" in line
            ]
            found[rank] = float(line.split()[-1])
        return found

    def ranks(launcher):
        found = [
            child for child in launcher.children(recursive=True) if "services.learner" in child.cmdline()
        ]
        return {child.environ()["RANK"]: child for child in found if "RANK" in child.environ()}

    flags = ("--run", "r", "--learners", 2, "--actors", 3, *TINY, "--evaluate", "false")
    stages = ("--learner.curriculum.stage-1", 3000, "--learner.curriculum.stage-2", 1000)
    ends = ("--learner.curriculum.stage-3", 10**9, "--learner.checkpoint-interval-s", 0.2)
    history = ("--actor.history", tmp_path / "history", "--learner.history", tmp_path / "history")
    with running(tmp_path, "deploy.local", *flags, *stages, *ends, *history) as command:
        wait_until(
            lambda: trained() > 6 and list(folder.glob("checkpoints/*.safetensors")), 90, "a checkpoint"
        )
        wait_until(lambda: update_seconds().keys() == {"0", "1"}, 30, "both learners to be watched")
        assert all(seconds > 0.0 for seconds in update_seconds().values())
        before = ranks(psutil.Process(command.process.pid))
        assert before.keys() == {"0", "1"}
        os.kill(before["1"].pid, signal.SIGKILL)
        before["0"].wait(30)
        at = trained()
        wait_until(lambda: trained() > at + 5, 90, "the next group to train")
        command.process.send_signal(signal.SIGINT)
        _, out, err = command.wait(90)

    ledger = last_json(out)["ledger"]
    assert ledger["published"] == sum(ledger[fate] for fate in FATES), err[-500:]
    assert ledger["trained"] > 20
    assert "process died name=learner-0" in err
    assert "learner of rank 1 ended with status -9" in err
    for rank in (0, 1):  # each learner had its own actors
        text = (tmp_path / f"history/learner-{rank}.jsonl").read_text()
        assert '"accepted"' in text
        assert ('["1", ' in text) == (rank == 1)
