"""User mistakes: each gives an exit status and one clear line, without a traceback or leftover processes."""

import re
import socket

import pytest

from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from tests.system.commands import TINY, run, running
from tests.waiting import wait_until

DEPLOY, LEARNER, ACTOR, TOPSPIN = ("deploy.local", "services.learner", "services.actor", "topspin")


def one_line(folder, module, *arguments):
    """Return the status and the last line of a command that must fail with one line of its own."""
    status, out, err = run(folder, module, *arguments, timeout_s=60)
    lines = err.strip().splitlines()
    assert status not in (0, None), err
    assert "Traceback" not in err
    assert out == ""
    prog = f"python -m {module}" if module != TOPSPIN else "topspin"
    assert sum(line.startswith(prog) for line in lines) == 1, err
    return status, lines[-1]


@pytest.mark.parametrize(
    ("module", "flags", "status", "line"),
    [
        (DEPLOY, "--actor 3", 2, r"unknown flag --actor; did you mean '--actors'\?"),
        (
            DEPLOY,
            "--actors many",
            2,
            r"local.actors = 'many' \(--actors\); allowed: a whole number, from 1 to 1000",
        ),
        (DEPLOY, "--actors 0", 2, r"local.actors = '0' \(--actors\); allowed: a whole number, from 1"),
        (DEPLOY, "--minutes", 2, "--minutes needs a value"),
        (DEPLOY, "--run a/b", 2, "run 'a/b' can't stand in a key"),
        (DEPLOY, "--run latest", 2, "run 'latest' is the name of the newest run"),
        (DEPLOY, "--resume", 2, "--resume needs --run NAME"),
        (
            DEPLOY,
            "--run unknown --resume",
            2,
            "run 'unknown' can't be resumed: there is no runs/unknown/config.toml",
        ),
        (DEPLOY, "--config nowhere.toml", 2, "can't read nowhere.toml: No such file"),
        (LEARNER, "--ppo.clipp 0.2", 2, r"unknown flag --ppo.clipp; did you mean '--ppo.clip'\?"),
        (LEARNER, "--endpoint udp/here", 2, "learner.endpoint = 'udp/here'"),
        (
            LEARNER,
            "--run unknown --resume",
            1,
            "nothing to resume in runs/unknown/checkpoints: no checkpoint there",
        ),
        (
            ACTOR,
            "--endpoint tcp/127.0.0.1:9 --connect-timeout-s 1",
            1,
            "no hub answered .* start the learner",
        ),
        (
            LEARNER,
            "--experience.teacher.policy nowhere",
            2,
            "no policy 'nowhere'; allowed: a policy folder, or one",
        ),
        (
            LEARNER,
            "--experience.teacher.policy p --ppo.correction-weight 0",
            2,
            "ppo.correction_weight 0 with experience.teacher.policy",
        ),
        (
            DEPLOY,
            "--experience.teacher.policy p --learner.ppo.correction-weight 0",
            2,
            "ppo.correction_weight 0 with experience.teacher.policy",
        ),
        (
            TOPSPIN,
            "evaluate --policy nowhere",
            2,
            "no policy 'nowhere'; allowed: a policy folder, or one of default, mild, paper",
        ),
        (
            TOPSPIN,
            "evaluate --rallies 0",
            2,
            r"evaluate.rallies = '0' \(--rallies\); allowed: a whole number, from 1",
        ),
        (TOPSPIN, "pley", 2, "unknown command 'pley'; did you mean 'play'"),
    ],
)
def test_a_mistake_ends_with_one_line_that_says_what_is_allowed(tmp_path, module, flags, status, line):
    found = one_line(tmp_path, module, *flags.split())

    assert found[0] == status
    assert re.search(line, found[1]), found[1]


def test_a_taken_port_of_the_learner_is_named(tmp_path):
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        endpoint = f"tcp/127.0.0.1:{holder.getsockname()[1]}"
        alone = one_line(tmp_path, LEARNER, "--endpoint", endpoint)
        whole = one_line(tmp_path, DEPLOY, "--run", "r", "--endpoint", endpoint, "--panel", "off")

    for status, line in (alone, whole):
        assert status == 1
        assert f"can't listen at {endpoint}" in line
        assert "Address already in use" in line


def test_an_address_that_is_not_this_machines_is_named_before_anything_starts(tmp_path):
    alone = one_line(tmp_path, ACTOR, "--metrics-host", "192.0.2.1")
    whole = one_line(tmp_path, DEPLOY, "--run", "r", "--metrics-host", "192.0.2.1")

    assert alone[0] == 1
    assert "can't serve metrics at 192.0.2.1:9100: Cannot assign" in alone[1]
    assert whole[0] == 2
    assert "metrics_host 192.0.2.1, port 9100: Cannot assign" in whole[1]
    assert not (tmp_path / "runs" / "r").exists()


def test_unreadable_files_are_named_with_their_faults(tmp_path):
    policy = tmp_path / "policy"
    policy.mkdir()
    (policy / "contract.json").write_text('{"format": 2}')
    (policy / "weights.safetensors").write_bytes(b"rubbish")
    checkpoints = tmp_path / "runs" / "r" / "checkpoints"
    checkpoints.mkdir(parents=True)
    (checkpoints / "00000001.safetensors").write_bytes(b"rubbish")
    learner = (LEARNER, "--run", "r", "--endpoint", "tcp/127.0.0.1:17483")

    assert (
        "weights.safetensors is not readable as safetensors"
        in one_line(tmp_path, TOPSPIN, "evaluate", "--policy", policy)[1]
    )
    assert (
        "checkpoint runs/r/checkpoints/00000001.safetensors is not readable"
        in (one_line(tmp_path, *learner, "--resume")[1])
    )
    assert "go on with --resume, or choose another --run" in one_line(tmp_path, *learner)[1]


def test_a_run_is_not_started_again_by_accident(tmp_path):
    (tmp_path / "runs" / "r" / "checkpoints").mkdir(parents=True)
    (tmp_path / "runs" / "r" / "config.toml").write_text("")
    (tmp_path / "runs" / "r" / "checkpoints" / "00000001.safetensors").write_bytes(b"")

    status, line = one_line(tmp_path, DEPLOY, "--run", "r")
    assert status == 2
    assert "run 'r' exists already in runs/r: go on with --resume, or choose another --run" in line


def test_a_run_started_service_by_service_is_not_resumed_as_a_whole(tmp_path):
    config = tmp_path / "runs" / "r" / "config.toml"
    config.parent.mkdir(parents=True)
    config.write_text("[learner]\nseed = 3\n")

    status, line = one_line(tmp_path, DEPLOY, "--run", "r", "--resume", "--panel", "off")

    assert status == 2
    assert "config.toml has no table [local]; go on with: python -m services.learner --run r --resume" in line
    assert config.read_text() == "[learner]\nseed = 3\n"


def test_a_live_run_is_not_started_or_resumed_a_second_time(tmp_path):
    folder = tmp_path / "runs" / "r"
    with running(tmp_path, DEPLOY, "--run", "r", *TINY) as first:
        wait_until(lambda: list((folder / "checkpoints").glob("*.safetensors")), 90, "a checkpoint")
        wait_until((folder / "policy" / "latest").exists, 30, "a policy")
        config = (folder / "config.toml").read_text()
        whole = one_line(tmp_path, DEPLOY, "--run", "r", "--resume", "--panel", "off")
        alone = one_line(tmp_path, LEARNER, "--run", "r", "--resume", "--endpoint", "tcp/127.0.0.1:17482")
        first.process.terminate()
        first.wait(60)

    assert whole[1].startswith(
        f"python -m deploy.local: run 'r' is alive: deploy.local, process {first.process.pid}, uses"
    )
    assert re.search(r"run 'r' is alive: learner, process \d+, uses runs/r; end it first", alone[1])
    assert (whole[0], alone[0]) == (1, 1)
    assert (folder / "config.toml").read_text() == config


def test_an_actor_without_a_learner_logs_its_wait_and_ends_on_a_signal(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    hub = open_zenoh(ZenohConfig(mode="hub", endpoint=endpoint))
    try:
        flags = ("--endpoint", endpoint, "--envs", 4, "--silence-warning-s", 0.5)
        with running(tmp_path, ACTOR, *flags) as actor:
            wait_until(
                lambda: (
                    "waiting for=\"a learner: run 'default' has none at the hub\"" in actor.err.read_text()
                ),
                60,
                "the actor to name the learner",
            )
            actor.process.terminate()
            status, _, err = actor.wait(20)
    finally:
        hub.close()

    assert status == 0
    assert "Traceback" not in err
