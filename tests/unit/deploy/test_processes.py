import os
import signal
import socket
import time
from contextlib import suppress

import pytest

from common.config import ConfigError, record
from common.process import BAD_CONFIG
from common.run_folder import RunAliveError, RunFolder
from deploy.child import Assignment
from deploy.config import HANDED_DOWN, DeployConfig, service_sections, shared_out, way_to_hub
from deploy.local import RunFailedError, check_ports, metrics_ports, prepared, settings, specs, spent
from deploy.processes import RESTART_PAUSE_MAX_S, RESTART_PAUSE_S, Family, Spec, restart_pause

CONFIG = DeployConfig(actors=3, generators=2, seed=7, metrics_port=9100)


def wait_until(condition, timeout_s=20.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_pauses_before_restarts_double_up_to_a_bound():
    pauses = [restart_pause(deaths) for deaths in range(1, 12)]

    assert pauses[:3] == [RESTART_PAUSE_S, 2 * RESTART_PAUSE_S, 4 * RESTART_PAUSE_S]
    assert pauses[-1] == RESTART_PAUSE_MAX_S
    assert pauses == sorted(pauses)


def flag(spec, name):
    return spec.arguments[spec.arguments.index(name) + 1]


def test_the_topology_is_one_learner_and_workers_that_come_back_each_with_a_port_of_its_own(tmp_path):
    family = specs(CONFIG, tmp_path / "config.toml")

    assert [spec.name for spec in family] == [
        *("learner-0", "evaluator-0", "generator-0", "generator-1", "actor-0", "actor-1", "actor-2"),
    ]
    assert [spec.name for spec in family if not spec.restart] == ["learner-0"]
    assert [int(flag(spec, "--metrics-port")) for spec in family] == list(range(9100, 9107))
    assert metrics_ports(CONFIG) == list(range(9100, 9107))
    assert [flag(spec, "--index") for spec in family if spec.role == "actor"] == ["0", "1", "2"]
    assert set(metrics_ports(CONFIG.model_copy(update={"metrics_port": 0}))) == {0}


def test_a_run_is_resumed_from_its_checkpoints_and_begun_anew_without_any(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    resumed = CONFIG.model_copy(update={"resume": True})
    assert "--resume" not in specs(resumed, tmp_path / "config.toml")[0].arguments

    (tmp_path / "checkpoints" / "00000001.safetensors").touch()

    assert "--resume" in specs(resumed, tmp_path / "config.toml")[0].arguments
    assert "--resume" not in specs(CONFIG, tmp_path / "config.toml")[0].arguments


def test_all_sections_agree_on_task_run_and_shards():
    config = DeployConfig(
        actors=3, launch="strong", env={"noise": "hard", "flight": "full"}, tls_ca="certs/ca.pem"
    )
    sections = service_sections(config, "r", "tcp/127.0.0.1:1", "runs/r")

    for name in ("run", "endpoint", "tls_ca", "seed", "launch"):
        assert len({str(section[name]) for section in sections.values()}) == 1, name
    assert sections["learner"]["env"] == sections["actor"]["env"] == sections["evaluator"]["env"]
    assert sections["learner"]["network"] == sections["actor"]["network"]
    assert sections["generator"]["noise"] == "hard"
    assert sections["generator"]["flight"] == "full"
    assert sections["actor"]["shards"] == sections["generator"]["shards"] == 3


@pytest.mark.parametrize(("actors", "envs"), [(1, 256), (2, 128), (8, 32), (16, 16), (100, 16), (1000, 16)])
def test_a_dataset_is_one_rollout_of_each_actor_and_as_large_with_up_to_16_of_them(actors, envs):
    config = shared_out(DeployConfig(actors=actors))
    intake = config.learner.intake

    assert (config.actor.envs, intake.dataset_rollouts) == (envs, actors)
    assert intake.queue_rollouts >= 2 * intake.dataset_rollouts


def test_what_a_run_hands_down_is_what_its_services_are_told():
    """Every name in the table, and no other: set on the run, it shows in the service's section."""
    changed = DeployConfig(
        seed=7,
        shards=9,
        generators=3,
        minutes=5,
        frames=6,
        launch="strong",
        tls_ca="ca.pem",
        tls_certificate="hub.pem",
        tls_key="hub.key",
        env={"noise": "hard", "flight": "full"},
        network={"units": (8, 4)},
    )
    usual, other = (
        service_sections(config, *words)
        for config, words in ((DeployConfig(), ("r", "e", "f")), (changed, ("s", "d", "g")))
    )
    to_all = {"run", "endpoint", "tls_ca", "tls_certificate", "tls_key", "seed"}
    for role, names in HANDED_DOWN.items():
        differing = {name for name in usual[role] if usual[role][name] != other[role][name]}
        constant = {"mode"} & set(names)
        assert differing | constant == set(names) | to_all, role


@pytest.mark.parametrize(
    ("flag", "instead"),
    [
        ("--learner.env.noise", "give --env.noise"),
        ("--generator.noise", "give --env.noise"),
        ("--actor.seed", "give --seed"),
        ("--learner.minutes", "give --minutes"),
        ("--generator.of", "give --generators"),
        ("--evaluator.network.units", "give --network.units"),
        ("--actor.index", "the run sets it"),
        ("--learner.id", "the run sets it"),
        ("--learner.metrics-port", "give --metrics-port"),
        ("--learner.resume", "give --resume"),
        ("--evaluator.policy", "the run sets it"),
        ("--actor.tls-key", "give --tls-key"),
    ],
)
def test_what_a_run_hands_down_cant_be_set_for_one_service(flag, instead):
    with pytest.raises(ConfigError, match=f"{flag} can't be set here: {instead}$"):
        settings([flag, "1"])


@pytest.mark.parametrize(
    ("variable", "instead"),
    [
        ("TOPSPIN_LEARNER__PPO__CLIP", "set TOPSPIN_LOCAL__LEARNER__PPO__CLIP$"),
        ("TOPSPIN_LEARNER__ENV__NOISE", "set TOPSPIN_LOCAL__ENV__NOISE$"),
        ("TOPSPIN_LOCAL__LEARNER__ENV__NOISE", "set TOPSPIN_LOCAL__ENV__NOISE$"),
        ("TOPSPIN_GENERATOR__NOISE", "set TOPSPIN_LOCAL__ENV__NOISE$"),
        ("TOPSPIN_ACTOR__INDEX", "the run sets it$"),
    ],
)
def test_a_variable_that_no_service_of_a_run_would_hear_of_is_refused(monkeypatch, variable, instead):
    monkeypatch.setenv(variable, "1")

    with pytest.raises(ConfigError, match=f"^{variable} would set nothing here: {instead}"):
        settings([])


def test_variables_of_a_run_reach_its_services_by_its_settings(monkeypatch):
    monkeypatch.setenv("TOPSPIN_LOCAL__LEARNER__PPO__CLIP", "0.1")
    monkeypatch.setenv("TOPSPIN_PLAY__RALLIES", "7")

    assert service_sections(settings([]), "r", "e", "f")["learner"]["ppo"]["clip"] == 0.1
    monkeypatch.setenv("TOPSPIN_LEARNER__PPO__CLAP", "0.1")
    with pytest.raises(ConfigError, match="CLAP; did you mean 'TOPSPIN_LOCAL__LEARNER__PPO__CLIP'"):
        settings([])


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (("--actor.envs", "64"), (64, 2)),
        (("--actor.envs", "256"), (256, 2)),
        (("--learner.intake.dataset-rollouts", "3"), (128, 3)),
        (("--learner.intake.dataset-rollouts", "1"), (128, 1)),
        (("--actor.envs", "0", "--learner.intake.dataset-rollouts", "0"), (128, 2)),
    ],
)
def test_environments_and_rollouts_that_were_asked_for_stay(flags, expected):
    config = shared_out(settings(["--run", "r", "--actors", "2", *flags]))

    assert (config.actor.envs, config.learner.intake.dataset_rollouts) == expected
    assert shared_out(config) == config


def test_a_resumed_run_has_the_settings_of_its_first_start_but_for_the_flags_given_now(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = settings(["--run", "r", "--actors", "5", "--network.units", "8,4", "--evaluator.rallies", "33"])
    with prepared(first):
        pass

    again = settings(["--run", "r", "--resume", "--minutes", "3"])
    newest = settings(["--run", "latest", "--resume"])

    assert again == first.model_copy(update={"resume": True, "minutes": 3.0})
    assert newest.run == "r"


@pytest.mark.parametrize("holder", ["deploy.local", "learner"])
def test_a_run_that_is_alive_is_refused_as_such_though_its_ports_are_taken_too(tmp_path, monkeypatch, holder):
    monkeypatch.chdir(tmp_path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        again = settings(["--run", "r", "--metrics-port", str(taken.getsockname()[1])])

        with (
            RunFolder.of("r").held_by(holder),
            pytest.raises(RunAliveError, match=f"alive: {holder}, process"),
        ):
            prepared(again).__enter__()

    assert not RunFolder.of("r").config.exists()


def dealt(config):
    """Return what each actor and the learner are told."""
    sections = service_sections(shared_out(config), "r", "tcp/127.0.0.1:1", "runs/r")
    return sections["actor"]["envs"], sections["learner"]["intake"]["dataset_rollouts"]


@pytest.mark.parametrize(
    ("begun", "resumed", "expected"),
    [
        ((), ("--actors", "8"), (32, 8)),
        ((), ("--actors", "2", "--actor.envs", "256"), (256, 2)),
        (("--actor.envs", "256"), ("--actors", "8"), (256, 8)),
        (("--actor.envs", "256"), (), (256, 2)),
        (("--learner.intake.dataset-rollouts", "3"), ("--actors", "4"), (64, 3)),
    ],
)
def test_a_run_that_goes_on_with_other_actors_shares_out_anew_what_nobody_asked_for(
    tmp_path, monkeypatch, begun, resumed, expected
):
    monkeypatch.chdir(tmp_path)
    with prepared(settings(["--run", "r", "--actors", "2", *begun])):
        pass

    assert dealt(settings(["--run", "r", "--resume", *resumed])) == expected


@pytest.mark.parametrize(
    ("recorded", "resumed", "expected"),
    [
        ((1, 256, 1), (), (256, 1)),
        ((1, 256, 1), ("--actors", "2"), (128, 2)),
        ((1, 256, 1), ("--actors", "2", "--actor.envs", "256"), (256, 2)),
        ((2, 128, 2), ("--actors", "8"), (32, 8)),
        ((2, 64, 2), (), (64, 2)),
        ((2, 64, 2), ("--actors", "4"), (64, 4)),
        ((1, 128, 1), ("--actors", "2"), (128, 2)),
        ((2, 128, 6), ("--actors", "4"), (64, 6)),
    ],
)
def test_a_record_of_what_each_actor_got_is_taken_for_nobody_having_asked(
    tmp_path, monkeypatch, recorded, resumed, expected
):
    monkeypatch.chdir(tmp_path)
    actors, envs, rollouts = recorded
    local = {"actors": actors, "actor": {"envs": envs}, "learner": {"intake": {"dataset_rollouts": rollouts}}}
    (tmp_path / "runs" / "r").mkdir(parents=True)
    record(RunFolder.of("r").config, {"local": local})

    assert dealt(settings(["--run", "r", "--resume", *resumed])) == expected


def test_a_run_goes_on_with_settings_that_fit_only_what_it_recorded(tmp_path, monkeypatch):
    """Lower bound of the rate from the record, upper one from a flag: judged by the defaults they would be crossed."""
    monkeypatch.chdir(tmp_path)
    with prepared(settings(["--run", "r", "--learner.ppo.learning-rate-min", "4e-6"])):
        pass

    resumed = settings(["--run", "r", "--resume", "--learner.ppo.learning-rate-max", "1.2e-5"])

    assert (resumed.learner.ppo.learning_rate_min, resumed.learner.ppo.learning_rate_max) == (4e-6, 1.2e-5)


def test_a_run_that_fails_before_it_trained_anything_keeps_its_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with prepared(settings(["--run", "r"])):
        pass
    before = RunFolder.of("r").config.read_text()

    def fail(*rows):
        with suppress(RunFailedError), prepared(settings(["--run", "r", "--resume", "--network.units", "8"])):
            RunFolder.of("r").metrics.write_text("\n".join(("epoch,frames,seconds", *rows, "")))
            raise RunFailedError("the checkpoint doesn't fit")

    fail()
    assert RunFolder.of("r").config.read_text() == before
    fail("1,8192,0.5")
    assert RunFolder.of("r").config.read_text() != before


def test_of_a_run_that_is_alive_deploy_is_named_first_who_ends_the_learner_before_its_actors(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for flags in (("--resume",), ()):
        with (
            prepared(settings(["--run", f"r{len(flags)}"])) as (name, folder, _),
            folder.held_by("learner"),
            pytest.raises(RunAliveError, match=f"run '{name}' is alive: deploy.local, "),
        ):
            prepared(settings(["--run", name, *flags])).__enter__()


TLS = ("--tls-ca", "ca.pem", "--tls-certificate", "hub.pem", "--tls-key", "hub.key")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--endpoint", "foo"), r"local.endpoint = 'foo' \(--endpoint\); allowed: text, matching .*tcp\|tls"),
        (("--endpoint", "tls/site:7447"), "allowed: all three with tls/..., none without"),
        (("--endpoint", "tls/site:7447", *TLS[:4]), "allowed: all three with tls/..., none without"),
        (TLS, "allowed: all three with tls/..., none without"),
    ],
)
def test_an_endpoint_that_nobody_could_reach_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, flags, message
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message), prepared(settings(["--run", "r", *flags])):
        pass

    assert not list(tmp_path.iterdir())


def test_the_run_itself_gets_to_the_hub_with_the_certificates_of_its_services():
    config = settings(["--endpoint", "tls/site:7447", *TLS])

    link = way_to_hub(config, config.endpoint)

    assert (link.endpoint, link.tls_ca, link.tls_certificate, link.tls_key) == (
        *("tls/site:7447", "ca.pem", "hub.pem", "hub.key"),
    )


def test_a_resumed_run_whose_budget_is_spent_is_told_what_is(tmp_path):
    folder = RunFolder(tmp_path)
    folder.metrics.write_text(
        "epoch,frames,seconds\n1,8192,1.5\n900,7372800,599.8\n901,73"
    )  # killed in a line
    resumed = CONFIG.model_copy(update={"resume": True, "minutes": 10.0})

    assert spent(resumed, folder) == "10 of 10 minutes"
    assert spent(resumed.model_copy(update={"minutes": 0.0}), folder) == ""
    assert spent(resumed.model_copy(update={"minutes": 20.0, "frames": 7_000_000}), folder) == (
        "7,372,800 of 7,000,000 frames"
    )
    assert spent(resumed, RunFolder(tmp_path / "nothing")) == ""


def test_a_free_port_passes_the_check():
    check_ports(CONFIG.model_copy(update={"metrics_port": 0}))


def test_an_assignment_survives_the_pipe():
    assignment = Assignment("runs/r/logs/actor-0.log", ("--id", "0", "--config", "a\nb"))

    line = assignment.to_line()

    assert line.count(b"\n") == 1
    assert Assignment.from_line(line) == assignment


@pytest.fixture
def service(tmp_path, monkeypatch):
    """A module that logs a line and ends as it is told."""
    (tmp_path / "stand_in.py").write_text(
        "import sys, time\n"
        "print('started', *sys.argv[1:], flush=True)\n"
        "sys.exit(int(sys.argv[2])) if sys.argv[1] == 'end' else time.sleep(600)\n"
    )
    root = os.getcwd()
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{root}")
    return "stand_in"


def kept(tmp_path, *arguments, restart=True):
    return Family([Spec("worker-0", "generator", arguments, restart)], tmp_path)


def test_a_process_that_dies_is_started_again_and_its_log_goes_on(tmp_path, service):
    family = kept(tmp_path, service, "stay")
    child, log = family.children["worker-0"], tmp_path / "worker-0.log"
    wait_until(lambda: "started" in log.read_text())
    os.kill(child.process.pid, signal.SIGKILL)
    wait_until(lambda: (family.watch(time.monotonic()), child.restarts == 1)[1])
    wait_until(lambda: log.read_text().count("started stay") == 2)
    alive = child.process.poll() is None
    family.stop(["worker-0"], 5.0)

    assert alive
    assert child.exits == [-signal.SIGKILL]
    assert child.process.poll() is not None


def test_a_process_gets_the_environment_but_no_settings_from_it(tmp_path, service, monkeypatch):
    (tmp_path / "stand_in.py").write_text(
        "import os\nprint('heard', os.environ.get('TOPSPIN_CONFIG'), os.environ.get('ELSE'), flush=True)\n"
    )
    monkeypatch.setenv("TOPSPIN_CONFIG", "other.toml")
    monkeypatch.setenv("ELSE", "kept")
    family = kept(tmp_path, service)
    wait_until(lambda: family.status_of("worker-0") is not None)
    family.stop(["worker-0"], 1.0)

    assert family.last_line("worker-0") == "heard None kept"


def test_a_process_that_cannot_use_its_settings_is_not_started_again(tmp_path, service):
    family = kept(tmp_path, service, "end", str(BAD_CONFIG))
    wait_until(lambda: (family.watch(time.monotonic()), family.hopeless())[1] == "worker-0")
    family.watch(time.monotonic() + 100.0)
    family.stop(["worker-0"], 1.0)

    assert family.children["worker-0"].restarts == 0
    assert family.last_line("worker-0") == f"started end {BAD_CONFIG}"


def test_a_process_ends_when_whoever_holds_its_pipe_does(tmp_path, service):
    family = kept(tmp_path, service, "stay")
    process = family.children["worker-0"].process
    wait_until(lambda: "started" in (tmp_path / "worker-0.log").read_text())

    process.stdin.close()

    assert process.wait(20) == -signal.SIGTERM
