"""Whole runs as a user starts them, with one process per service."""

import csv
import json
import re
import signal
import time
import tomllib
from threading import Event

import pytest

from common.policy.folder import load_policy
from tests.system.commands import DATASET, STAGES, TINY, children_of, last_json, run, running
from tests.waiting import wait_until
from topspin.certs import main

FATES = ("trained", "refused", "dropped", "in_flight", "lost")
MEASURES = ("catch_rate", "over_rate", "return_rate", "return_after_catch")


def rows(folder, name="r"):
    path = folder / "runs" / name / "metrics.csv"
    if not path.exists():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def test_a_run_with_certificates_goes_through_its_stages_and_leaves_a_complete_folder_and_one_json_line(
    tmp_path,
):
    main(["--out", str(tmp_path / "certs"), "--actors", "2"], Event())
    status, out, err = run(
        tmp_path,
        "deploy.local",
        *("--run", "r", "--actors", 2, "--tls", "certs"),
        *TINY,
        *STAGES,
        "--learner.curriculum.stage-3",
        4 * DATASET,
    )
    folder = tmp_path / "runs" / "r"
    line = last_json(out)
    ledger = line["ledger"]

    assert status == 0, err
    assert "Traceback" not in err
    assert len(out.strip().splitlines()) == 1
    assert (line["run"], line["stage"], line["frames"]) == ("r", 3, 9 * DATASET)
    assert line["policy"] == "runs/r/policy/latest"
    assert line["seconds"] > 0
    assert line["rallies"] == 40
    for name in MEASURES:
        low, high = line[f"{name}_ci"]
        assert 0 <= low <= (line[name] or 0.0) <= high <= 1
    assert {"target_error_mean", "target_error_median", "launch", "randomization"} <= line.keys()
    assert ledger["published"] == sum(ledger[fate] for fate in FATES)
    assert (ledger["trained"], ledger["lost"], ledger["dropped"], ledger["refused"]) == (18, 0, 0, 0)
    assert [int(row["stage"]) for row in rows(tmp_path)] == [1, 1, 2, 2, 3, 3, 3, 3, 3]
    assert load_policy(folder / "policy" / "latest").contract.version == 9
    assert load_policy(folder / "policy" / "best").contract.measures["rallies"] == 20
    assert list((folder / "checkpoints").glob("*.safetensors"))
    assert list((folder / "tb").iterdir())
    assert {"deploy", "learner-0", "generator-0", "actor-0", "actor-1", "evaluator-0"} <= {
        path.stem for path in (folder / "logs").iterdir()
    }
    assert (tmp_path / "runs" / "latest").resolve() == folder
    assert "endpoint=tls/127.0.0.1:" in err
    for name in ("learner-0", "actor-0", "actor-1", "generator-0", "evaluator-0"):
        assert f"link secured certificate=certs/{name}.pem" in (folder / "logs" / f"{name}.log").read_text()
    assert "link secured certificate=certs/operator-0.pem" in err
    assert "is not in the folder" not in (folder / "logs" / "learner-0.log").read_text()


def test_an_actor_killed_by_hand_is_back_and_counted_within_seconds_and_an_interrupted_run_goes_on(tmp_path):
    flags = ("--run", "r", "--actors", 2, *TINY, *STAGES, "--learner.curriculum.stage-3", 10**9)
    with running(tmp_path, "deploy.local", *flags) as command:
        wait_until(lambda: len(rows(tmp_path)) >= 6, 90, "stage 3")
        wait_until((tmp_path / "runs" / "r" / "logs" / "spare.log").exists, 30, "a spare process")
        epoch = len(rows(tmp_path))
        wait_until(lambda: len(rows(tmp_path)) >= epoch + 50, 30, "more epochs")
        before = children_of(tmp_path, "actor")
        victim = next(process for process in before.values() if "--id" in process.cmdline())
        index = victim.cmdline()[victim.cmdline().index("--id") + 1]
        log = tmp_path / "runs" / "r" / "logs" / f"actor-{index}.log"
        policies = log.read_text().count("policy received")
        victim.kill()
        killed = time.monotonic()
        wait_until(
            lambda: log.read_text().count("policy received") > policies, 30, "the killed actor to return"
        )
        took = time.monotonic() - killed
        epoch = len(rows(tmp_path))
        wait_until(lambda: len(rows(tmp_path)) >= epoch + 4, 30, "training to go on")
        command.process.send_signal(signal.SIGINT)
        status, out, err = command.wait(60)
    first, trained = last_json(out), rows(tmp_path)

    resume = ("--run", "r", "--resume", "--frames", first["frames"] + 20 * 1024, "--json")
    again, out, err_again = run(tmp_path, "deploy.local", *resume)
    second, retrained = last_json(out), rows(tmp_path)

    assert took < 5.0
    assert "process died name=actor-" in err
    assert "status=-9" in err
    assert status == 130, err
    assert "go on with: python -m deploy.local --run r --resume" in err
    assert "catch_rate" not in first
    assert first["ledger"]["published"] == sum(first["ledger"][fate] for fate in FATES)
    assert first["frames"] == int(trained[-1]["frames"])
    assert again == 0, err_again
    assert second["frames"] == first["frames"] + 20 * 1024
    assert second["ledger"]["published"] == sum(second["ledger"][fate] for fate in FATES)
    # the second part's rows follow the first's without a gap: it had the same settings
    assert retrained[: len(trained)] == trained
    assert [int(row["epoch"]) for row in retrained] == list(range(1, len(trained) + 21))
    assert second["ledger"]["trained"] == 2 * len(retrained)
    assert second["seconds"] > first["seconds"]


def test_a_killed_learner_restarts_with_resume_while_its_workers_live_on(tmp_path):
    endpoint = "tcp/127.0.0.1:17481"
    common = ("--run", "r", "--endpoint", endpoint, "--seed", 1)
    network = ("--network.units", "32,16")
    learner = (
        *common,
        *network,
        "--curriculum.stage-1",
        1536,
        "--curriculum.stage-2",
        1024,
        "--curriculum.stage-3",
        10**9,
    )
    learner = (*learner, "--ppo.minibatch", 256, "--checkpoint-interval-s", 0.2)
    with (
        running(tmp_path, "services.generator", *common),
        # It gets its number, and the network, from the learner
        running(tmp_path, "services.actor", *common[:4], "--envs", 32, "--horizon", 16) as actor,
    ):
        with running(tmp_path, "services.learner", *learner) as first:
            wait_until(lambda: len(rows(tmp_path)) >= 20, 90, "training")
            first.process.kill()
        frames = int(rows(tmp_path)[-1]["frames"])
        resume = (
            "--run",
            "r",
            "--resume",
            "--frames",
            frames + 30_000,
        )  # the other settings are in config.toml
        with running(tmp_path, "services.learner", *resume) as second:
            status, _, err = second.wait(60)
        actor.process.send_signal(signal.SIGTERM)
        actor_status, _, actor_err = actor.wait(30)
    log = load_policy(tmp_path / "runs" / "r" / "policy" / "latest").contract

    assert status == 0, err
    assert "resumed file=runs/r/checkpoints/" in err
    recorded = tomllib.loads((tmp_path / "runs" / "r" / "config.toml").read_text())
    assert (recorded["frames"], recorded["seed"], recorded["run"]) == (frames + 30_000, 1, "r")
    assert actor_status == 0, actor_err
    assert "Traceback" not in actor_err
    assert "place given actor=0 index=0" in first.err.read_text()
    assert len(set(re.findall(r"policy received generation=(\d+)", actor_err))) == 2
    epochs = [int(row["epoch"]) for row in rows(tmp_path)]
    assert epochs == list(range(1, len(epochs) + 1))  # epochs after the last checkpoint are trained again
    assert log.frames >= frames + 30_000
    assert (log.stage, int(rows(tmp_path)[-1]["stage"])) == (3, 3)


def test_a_killed_learner_and_a_hung_actor_come_back_by_themselves(tmp_path):
    flags = ("--run", "r", "--actors", 2, *TINY, *STAGES, "--learner.curriculum.stage-3", 10**9)
    flags += ("--watchdog-s", 6, "--learner.checkpoint-interval-s", 1)
    with running(tmp_path, "deploy.local", *flags) as command:
        wait_until(lambda: len(rows(tmp_path)) >= 60, 90, "training")
        wait_until(lambda: list((tmp_path / "runs/r/checkpoints").glob("*.safetensors")), 30, "a checkpoint")
        (learner,) = children_of(tmp_path, "learner").values()
        learner.kill()
        log = tmp_path / "runs" / "r" / "logs" / "learner-0.log"
        wait_until(lambda: "resumed file=" in log.read_text(), 60, "the learner's next life")
        epoch = len(rows(tmp_path))
        wait_until(lambda: len(rows(tmp_path)) >= epoch + 20, 60, "training to go on")
        hung = next(p for p in children_of(tmp_path, "actor").values() if "--id" in p.cmdline())
        hung.suspend()
        wait_until(lambda: "process hangs name=actor-" in command.err.read_text(), 60, "the watchdog")
        epoch = len(rows(tmp_path))
        wait_until(lambda: len(rows(tmp_path)) >= epoch + 20, 60, "training to go on again")
        command.process.send_signal(signal.SIGINT)
        status, out, err = command.wait(60)
    ledger = last_json(out)["ledger"]

    assert status == 130, err
    assert "process died name=learner-0" in err
    assert "status=-9" in err
    assert ledger["published"] == sum(ledger[fate] for fate in FATES)
    assert "go on with: python -m deploy.local --run r --resume" in err


def test_a_second_interrupt_ends_everything_at_once(tmp_path):
    with running(tmp_path, "deploy.local", "--run", "r", "--actors", 1, *TINY) as command:
        wait_until(lambda: len(rows(tmp_path)) >= 1, 90, "the first epoch")
        command.process.send_signal(signal.SIGINT)
        wait_until(
            lambda: "stopping signal=SIGINT" in command.err.read_text(), 10, "the first signal's log line"
        )
        command.process.send_signal(signal.SIGINT)
        status, _, _ = command.wait(5)

    assert status == 130  # the fixture checks that no process is left


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_when_the_parent_ends_so_do_its_processes(tmp_path, number):
    with running(tmp_path, "deploy.local", "--run", "r", "--actors", 1, *TINY) as command:
        wait_until(lambda: len(rows(tmp_path)) >= 1, 90, "the first epoch")
        command.process.send_signal(number)
        status, out, _ = command.wait(60)

    assert status == (130 if number == signal.SIGTERM else -9)
    if number == signal.SIGTERM:
        assert json.loads(out.splitlines()[-1])["run"] == "r"
