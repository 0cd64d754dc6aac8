import os
import shutil
import socket
import tomllib
from contextlib import suppress
from pathlib import Path
from threading import Event

import pytest

from common.comms.certificates import CertificateError
from common.errors import ConfigError
from common.service.config import load
from common.service.config_sources import read_toml
from common.service.run_folder import RunAliveError, RunFolder, newest_run
from deploy.config import DeployConfig, settings
from deploy.prepare import PreparedRun, RunFailedError, link_to_learner, metrics_ports, new_name, prepared
from services.actor.config import ActorConfig
from services.evaluator.config import EvaluatorConfig
from services.generator.config import GeneratorConfig
from services.learner.config import LearnerConfig
from topspin.certs import main

CONFIG = DeployConfig(actors=3, generators=2, seed=7, metrics_port=9100)
SERVICES = {
    "learner": LearnerConfig,
    "actor": ActorConfig,
    "generator": GeneratorConfig,
    "evaluator": EvaluatorConfig,
}


def read(*argv):
    return settings(argv, "p")


def a_run(config, folder):
    return PreparedRun("r", config, RunFolder(folder), link_to_learner(config, "tcp/127.0.0.1:1"))


def flag(spec, name):
    return spec.arguments[spec.arguments.index(name) + 1]


def test_the_topology_is_one_learner_and_restarted_workers_each_with_its_own_port(tmp_path):
    specs = a_run(CONFIG, tmp_path).specs()

    assert [spec.name for spec in specs] == [
        *("learner-0", "evaluator-0", "generator-0", "generator-1", "actor-0", "actor-1", "actor-2"),
    ]
    assert all(spec.restart for spec in specs)
    assert [spec.name for spec in specs if spec.keeps_run] == ["learner-0"]
    ports = [int(flag(spec, "--metrics-port")) for spec in specs]
    assert ports == sorted(set(ports))
    assert ports[0] >= 9100
    assert [flag(spec, "--index") for spec in specs if spec.role == "actor"] == ["0", "1", "2"]
    assert set(metrics_ports(CONFIG.model_copy(update={"metrics_port": 0}))) == {0}


def test_a_run_is_resumed_from_its_checkpoints_and_starts_from_the_beginning_without_any(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    resumed = CONFIG.model_copy(update={"resume": True})
    assert "--resume" not in a_run(resumed, tmp_path).specs()[0].arguments

    (tmp_path / "checkpoints" / "00000001.safetensors").touch()

    assert "--resume" in a_run(resumed, tmp_path).specs()[0].arguments
    assert "--resume" not in a_run(CONFIG, tmp_path).specs()[0].arguments


def settings_of_services(run):
    """Return the settings that each service of a run reads, by role, the first of each."""
    found = {}
    for spec in run.specs():
        if spec.role not in found:
            argv = spec.arguments[1:]
            found[spec.role] = load(SERVICES[spec.role], argv, prog="s", section=spec.role, environ={})
    return found


def test_every_service_reads_the_runs_settings_from_its_one_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = (
        "--run r --actors 3 --generators 2 --seed 7 --minutes 5 --log-level warning --task.launch strong "
        "--task.randomization hard --task.flight full --network.units 8,4 --experience.continue-share 0.3 "
        "--learner.ppo.clip 0.1 --actor.horizon 16 --generator.batch 64 --evaluator.rallies 33"
    )
    with prepared(read(*flags.split())) as run:
        found = settings_of_services(run)
        endpoint = run.link.endpoint

    assert {config.run for config in found.values()} == {"r"}
    assert {config.seed for config in found.values()} == {7}
    assert {config.endpoint for config in found.values()} == {endpoint}
    assert {config.log_level for config in found.values()} == {"warning"}
    assert all(config.task == run.config.task for config in found.values())
    assert found["learner"].task.launch == "strong"
    assert found["learner"].experience == found["actor"].experience == run.config.experience
    assert found["learner"].network == found["actor"].network == found["evaluator"].network
    assert (found["learner"].ppo.clip, found["learner"].minutes) == (0.1, 5.0)
    assert (found["actor"].horizon, found["generator"].batch, found["evaluator"].rallies) == (16, 64, 33)
    assert found["actor"].shard_count == found["generator"].shard_count == 3


@pytest.mark.parametrize(("actors", "envs"), [(1, 256), (2, 128), (8, 32), (16, 16), (100, 16), (1000, 16)])
def test_a_dataset_is_one_rollout_of_each_actor_and_as_large_with_up_to_16_of_them(actors, envs):
    intake = LearnerConfig(actors=actors).intake.for_actors(actors)

    assert (ActorConfig(actors=actors).env_count, intake.dataset_rollouts) == (envs, actors)
    assert intake.queue_rollouts >= 2 * intake.dataset_rollouts


@pytest.mark.parametrize(
    ("begun", "resumed", "expected"),
    [
        ((), (), (128, 2)),
        ((), ("--actors", "8"), (32, 8)),
        ((), ("--actors", "2", "--actor.envs", "256"), (256, 2)),
        (("--actor.envs", "256"), ("--actors", "8"), (256, 8)),
        (("--actor.envs", "256"), (), (256, 2)),
        (("--learner.intake.dataset-rollouts", "3"), ("--actors", "4"), (64, 3)),
    ],
)
def test_a_resumed_run_divides_environments_again_unless_they_are_set(
    tmp_path, monkeypatch, begun, resumed, expected
):
    monkeypatch.chdir(tmp_path)
    with prepared(read("--run", "r", "--actors", "2", *begun)):
        pass

    with prepared(read("--run", "r", "--resume", *resumed)) as run:
        found = settings_of_services(run)

    learner = found["learner"]
    intake = learner.intake.for_actors(learner.actors)
    assert (found["actor"].env_count, intake.dataset_rollouts) == expected


@pytest.mark.parametrize(
    ("flag", "hint"),
    [
        ("--learner.task.randomization", "did you mean"),
        ("--generator.launch", "did you mean"),
        ("--actor.seed", "did you mean"),
        ("--learner.minutes", "did you mean"),
        ("--learner.metrics-port", "did you mean"),
    ],
)
def test_shared_settings_cant_be_set_for_one_service(flag, hint):
    with pytest.raises(ConfigError, match=f"unknown flag {flag}; {hint}"):
        read(flag, "1")


def test_variables_of_services_set_a_runs_settings(monkeypatch):
    monkeypatch.setenv("TOPSPIN_LEARNER__PPO__CLIP", "0.1")
    monkeypatch.setenv("TOPSPIN_TASK__LAUNCH", "strong")
    monkeypatch.setenv("TOPSPIN_PLAY__RALLIES", "7")
    found = read()

    assert (found.learner.ppo.clip, found.task.launch) == (0.1, "strong")
    monkeypatch.setenv("TOPSPIN_LEARNER__PPO__CLAP", "0.1")
    with pytest.raises(ConfigError, match="CLAP; did you mean 'TOPSPIN_LEARNER__PPO__CLIP'"):
        read()


def test_a_resumed_run_has_its_recorded_settings_except_for_new_flags(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = read("--run", "r", "--actors", "5", "--network.units", "8,4", "--evaluator.rallies", "33")
    with prepared(first):
        pass

    again = read("--run", "r", "--resume", "--minutes", "3")
    newest = read("--run", "latest", "--resume")

    changed = {"resume": True, "minutes": 3.0, "endpoint": again.endpoint}
    assert again == first.model_copy(update=changed)
    assert newest.run == "r"


def test_settings_that_a_learner_changed_alone_are_the_runs(tmp_path, monkeypatch):
    """The learner writes the same file, so both ways to resume read the same settings."""
    from common.service.config import save_settings, to_tables
    from services.learner.__main__ import settings as learner_settings

    monkeypatch.chdir(tmp_path)
    with prepared(read("--run", "r", "--actors", "2")) as run:
        file = run.folder.config
    by_hand = learner_settings(["--run", "r", "--resume", "--ppo.clip", "0.1"])
    save_settings(file, to_tables(by_hand, "learner"))

    assert by_hand.actors == 2
    assert read("--run", "r", "--resume").learner.ppo.clip == 0.1
    assert "id" not in tomllib.loads(file.read_text())["learner"]


@pytest.mark.parametrize("holder", ["deploy.local", "learner"])
def test_a_live_run_is_refused_as_alive_even_if_its_metrics_cant_be_served_either(
    tmp_path, monkeypatch, holder
):
    monkeypatch.chdir(tmp_path)
    again = read("--run", "r", "--metrics-host", "192.0.2.1")

    with RunFolder.of("r").held_by(holder), pytest.raises(RunAliveError, match=f"alive: {holder}, process"):
        prepared(again).__enter__()

    assert not RunFolder.of("r").config.exists()


def test_a_flag_is_checked_together_with_the_recorded_settings(tmp_path, monkeypatch):
    """Lower bound of the rate from the file, upper bound from a flag: with the default bounds each would be refused."""
    monkeypatch.chdir(tmp_path)
    with prepared(read("--run", "r", "--learner.ppo.learning-rate-min", "4e-6")):
        pass

    resumed = read("--run", "r", "--resume", "--learner.ppo.learning-rate-max", "1.2e-5")

    assert (resumed.learner.ppo.learning_rate_min, resumed.learner.ppo.learning_rate_max) == (4e-6, 1.2e-5)


def test_a_run_that_fails_before_it_trained_anything_keeps_its_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with prepared(read("--run", "r")):
        pass
    before = RunFolder.of("r").config.read_text()

    def fail(*rows):
        with suppress(RunFailedError), prepared(read("--run", "r", "--resume", "--network.units", "8")):
            RunFolder.of("r").metrics.write_text("\n".join(("epoch,frames,seconds", *rows, "")))
            raise RunFailedError("the checkpoint doesn't fit")

    fail()
    assert RunFolder.of("r").config.read_text() == before
    fail("1,8192,0.5")
    assert RunFolder.of("r").config.read_text() != before


def test_what_a_killed_process_left_in_the_folder_is_gone_before_anybody_asks_for_actors(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with prepared(read("--run", "r")) as run:
        run.folder.targets.write_text("[]")
        run.folder.wanted_actors.write_text("5\n")

    with prepared(read("--run", "r", "--resume")) as run:
        assert not run.folder.targets.exists()
        assert not run.folder.wanted_actors.exists()


def test_this_process_waits_for_the_learner_as_long_as_the_services_do(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with prepared(read("--run", "r", "--connect-timeout-s", "300")) as run:
        assert run.link.connect_timeout_s == 300.0


def test_a_new_run_that_trained_nothing_leaves_its_name_and_the_newest_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with prepared(read("--run", "good")):
        pass

    with suppress(RunFailedError), prepared(read("--run", "r", "--network.units", "8")):
        raise RunFailedError("no writer 'nope'")
    assert newest_run() == "good"

    with suppress(RunFailedError), prepared(read("--run", "r", "--network.units", "16")) as run:
        assert run.config.network.units == (16,)
        run.folder.metrics.write_text("epoch,frames,seconds\n1,8192,0.5\n")
        raise RunFailedError("it was killed")
    assert newest_run() == "r"

    with pytest.raises(ConfigError, match="run 'r' exists already"):
        prepared(read("--run", "r")).__enter__()


def test_for_a_live_run_deploy_is_named_before_its_learner(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for flags in (("--resume",), ()):
        with (
            prepared(read("--run", f"r{len(flags)}")) as run,
            run.folder.held_by("learner"),
            pytest.raises(RunAliveError, match=f"run '{run.name}' is alive: deploy.local, "),
        ):
            prepared(read("--run", run.name, *flags)).__enter__()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--endpoint", "foo"), r"local.endpoint = 'foo' \(--endpoint\); allowed: text, matching .*tcp\|tls"),
        (("--endpoint", "tls/site:7447"), "allowed: an endpoint tls/... with --tls DIR"),
        (("--endpoint", "tcp/site:7447", "--tls", "certs"), "allowed: an endpoint tls/... with --tls DIR"),
        (
            ("--tls", "certs", "--actors", "2"),
            "--tls certs has no certificate of learner-0,evaluator-0,generator-0,actor-0,actor-1,operator-0; "
            "make them with: topspin certs --out certs --add learner-0,",
        ),
    ],
)
def test_an_endpoint_that_no_service_could_reach_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, flags, message
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message), prepared(read("--run", "r", *flags)):
        pass

    assert not list(tmp_path.iterdir())


def test_a_run_with_tls_listens_with_it_and_checks_every_certificate(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["--days", "1"], Event())
    with prepared(read("--run", "r", "--tls", "certs")) as run:
        link, written = run.link, read_toml(run.folder.config)
    Path("certs/actor-0.key").write_text("no key")
    with pytest.raises(CertificateError, match=r"actor-0.key can't be read as a key"):
        prepared(read("--run", "s", "--tls", "certs")).__enter__()

    assert (link.endpoint.partition("/")[0], link.tls) == ("tls", "certs")
    assert (written["endpoint"], written["tls"]) == (link.endpoint, "certs")


def test_a_resumed_run_with_a_spent_budget_names_the_limit(tmp_path):
    RunFolder(tmp_path).metrics.write_text(
        "epoch,frames,seconds\n1,8192,1.5\n900,7372800,599.8\n901,73"  # killed within a line
    )
    resumed = CONFIG.model_copy(update={"resume": True, "minutes": 10.0})

    def spent(**changes):
        return a_run(resumed.model_copy(update=changes), tmp_path).spent()

    assert spent() == "10 of 10 minutes"
    assert spent(minutes=0.0) == ""
    assert spent(minutes=20.0, frames=7_000_000) == "7,372,800 of 7,000,000 frames"
    assert a_run(resumed, tmp_path / "nothing").spent() == ""


def test_ports_of_metrics_leave_out_those_that_are_taken():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        found = metrics_ports(CONFIG.model_copy(update={"metrics_port": min(port, 64000)}))

    assert len(found) == 7
    assert port not in found
    assert found == sorted(found)


def test_an_address_that_cant_be_served_is_one_line():
    with pytest.raises(
        ConfigError, match=r"metrics_host 192\.0\.2\.1, port 9100: .*; allowed: an address of this"
    ):
        metrics_ports(CONFIG.model_copy(update={"metrics_host": "192.0.2.1"}))


def test_runs_without_a_name_that_start_together_get_names_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    names = [new_name("20260101-120000") for _ in range(3)]

    assert names == ["20260101-120000", "20260101-120000-2", "20260101-120000-3"]
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == names


def started(*argv):
    with prepared(read(*argv)) as run:
        return run


def test_runs_that_were_copied_as_plain_files_go_on(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    started("--run", "a")
    shutil.copytree("runs", tmp_path / "there" / "runs")  # as cp -rL: the link becomes a folder
    monkeypatch.chdir(tmp_path / "there")
    run = started("--run", "a", "--resume")

    assert run.name == "a"
    assert not Path("runs/latest").is_symlink()
    assert newest_run() == "a"


def test_without_the_link_the_newest_run_is_that_which_was_written_last(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, when in (("a", 2_000), ("b", 1_000)):
        started("--run", name)
        os.utime(f"runs/{name}/config.toml", (when, when))
    linked = newest_run()
    Path("runs/latest").unlink()

    assert linked == "b"
    assert newest_run() == "a"
    assert read("--run", "latest", "--resume").run == "a"
    with pytest.raises(ConfigError, match="--resume needs --run NAME: the newest run is a"):
        read("--resume")
