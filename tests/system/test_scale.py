"""A run gets more actors while it runs, and fewer again, and no rollout is lost."""

import json
import signal

from tests.system.commands import STAGES, TINY, last_json, run, running
from tests.waiting import wait_until


def test_a_running_training_gets_more_actors_and_fewer_again(tmp_path):
    def actors():
        try:
            groups = json.loads((tmp_path / "runs/r/targets.json").read_text())
        except FileNotFoundError:
            return set()
        return {group["labels"]["id"] for group in groups if group["labels"]["role"] == "actor"}

    def scale(count):
        return run(tmp_path, "topspin", "scale", "--run", "r", "--actors", count)

    flags = ("--run", "r", "--actors", 1, *TINY, *STAGES, "--learner.curriculum.stage-3", 10**9, "--json")
    history = tmp_path / "history"
    refused, _, reason = scale(3)
    with running(tmp_path, "deploy.local", *flags, "--actor.history", history) as command:
        wait_until(lambda: actors() == {"0"}, 60, "the run to start")
        status, told, _ = scale(3)
        wait_until(lambda: actors() == {"0", "1", "2"}, 60, "three actors")
        for number in range(3):
            file = history / f"actor-{number}.jsonl"
            wait_until(
                lambda f=file: f.exists() and '"accepted"' in f.read_text(), 60, f"{file.stem} to train"
            )
        scale(1)
        wait_until(lambda: actors() == {"0"}, 60, "one actor")
        ends = [(history / f"actor-{number}.jsonl").read_text().splitlines()[-1] for number in (1, 2)]
        command.process.send_signal(signal.SIGINT)
        _, out, err = command.wait(90)

    assert refused != 0
    assert "no topspin train keeps the run" in reason
    assert (status, told) == (0, "run r: 3 actors from now on; its panel and log show them\n")
    for end in map(json.loads, ends):
        assert end["event"] == "end"
        assert end["in_flight"] == []
    assert last_json(out)["ledger"]["lost"] == 0, err[-500:]
    assert "one more actor name=actor-2" in err
    assert "actor has ended name=actor-2" in err
