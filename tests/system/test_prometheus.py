"""A real Prometheus beside a run of real processes, with the settings and rules of deploy/monitoring."""

import json
import resource
import shutil
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from contextlib import closing, contextmanager

import psutil
import pytest
import yaml

from benchmarks.chaos.slow_wire import SlowWire
from common.comms.keys import Keys
from common.comms.transport import Flow
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from deploy.manifests import alarms, panels
from deploy.manifests.files import prometheus
from deploy.prepare import free_port
from tests.system.commands import STAGES, TINY, children_of, running
from tests.waiting import wait_until

pytestmark = pytest.mark.skipif(
    shutil.which("prometheus") is None, reason="prometheus is not installed (Debian: apt install prometheus)"
)

OF_A_BUSY_MACHINE = {"TopspinNoRallies", "TopspinRolloutsTooOld", "TopspinActorsLag"}  # rightly raised there


class Api:
    """Prometheus' HTTP interface."""

    def __init__(self, port):
        self.port = port

    def get(self, path, **parameters):
        query = urllib.parse.urlencode(parameters)
        url = f"http://127.0.0.1:{self.port}/api/v1/{path}?{query}"
        try:
            with urllib.request.urlopen(url, timeout=10) as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            if error.code == 503:  # it reads its files
                return None
            raise AssertionError(f"{parameters}: {error.read().decode()}") from None
        except OSError:  # it has not begun to listen
            return None

    def health(self):
        """Return the health of each target by role and id."""
        found = self.get("targets", state="active")
        return {
            (target["labels"]["role"], target["labels"]["id"]): target["health"]
            for target in (found["activeTargets"] if found else [])
        }

    def has_data(self, expression):
        return bool(self.get("query", query=expression)["result"])

    def all_firing(self):
        """Return name, role and id of each alarm that stands."""
        found = [alert["labels"] for alert in self.get("alerts")["alerts"] if alert["state"] == "firing"]
        return {(labels["alertname"], labels["role"], labels["id"]) for labels in found}

    def firing(self):
        """Return the same without those that a busy machine raises."""
        return {alarm for alarm in self.all_firing() if alarm[0] not in OF_A_BUSY_MACHINE}


@contextmanager
def prometheus_of(folder, shorter=()):
    """Yield a Prometheus that watches the run in ``folder``; its intervals and waits are shortened to 1 s.

    Args:
        folder: Of the run. Targets of other processes are read from its more.json.
        shorter: Texts of the rules' expressions, and shorter ones for them.
    """
    rules, config, port = alarms.rules(), prometheus(), free_port()
    for group in rules["groups"]:
        group["interval"] = "1s"
        for rule in group["rules"]:
            rule.pop("for", None)
            for long, short in shorter:
                rule["expr"] = rule["expr"].replace(long, short)
    config["global"] = {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"}
    config["rule_files"] = [str(folder / "alerts.yml")]
    (discovery,) = config["scrape_configs"][0]["file_sd_configs"]
    files = [str(folder / "runs/latest/targets.json"), str(folder / "more.json")]
    discovery |= {"files": files, "refresh_interval": "1s"}
    (folder / "alerts.yml").write_text(yaml.safe_dump(rules))
    (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
    with (folder / "prometheus.log").open("w") as log:
        process = subprocess.Popen(
            [
                *(
                    "prometheus",
                    f"--config.file={folder}/prometheus.yml",
                    f"--storage.tsdb.path={folder}/tsdb",
                ),
                f"--web.listen-address=127.0.0.1:{port}",
            ],
            cwd=folder,
            stdout=log,
            stderr=log,
        )
    try:
        yield Api(port)
    finally:
        process.terminate()
        process.wait(30)


def test_every_target_is_up_every_expression_has_data_and_an_alarm_stands_when_its_cause_does(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    flags = ("--run", "r", "--actors", 2, "--endpoint", endpoint, *TINY, *STAGES)
    services = {("learner", "0"), ("evaluator", "0"), ("generator", "0"), ("actor", "0"), ("actor", "1")}
    expressions = [text.replace("$run", "r") for text in panels.expressions()]
    expressions += [alarm.signal for alarm in alarms.ALARMS] + [alarms.WAIT_SHARE]
    with (
        running(tmp_path, "deploy.local", *flags, "--learner.curriculum.stage-3", 10**9),
        prometheus_of(tmp_path) as api,
    ):
        wait_until(lambda: api.health() == dict.fromkeys(services, "up"), 120, "every target")
        waiting = set(expressions)

        def all_have_data():
            waiting.difference_update([text for text in waiting if api.has_data(text)])
            return not waiting

        try:
            wait_until(all_have_data, 120, "every expression to have data")
        except AssertionError as error:
            raise AssertionError(f"no data: {waiting}") from error
        # without their waits some stand while a run starts, such as that nothing is trained
        wait_until(lambda: not api.firing(), 60, lambda: f"these alarms of the start to end: {api.firing()}")

        (generator,) = children_of(tmp_path, "generator").values()
        generator.suspend()
        try:
            wait_until(lambda: ("TopspinServiceDown", "generator", "0") in api.firing(), 60, "its alarm")
        finally:
            generator.resume()
        wait_until(lambda: not any(n == "TopspinServiceDown" for n, *_ in api.firing()), 60, "its end")
        assert not any(name == "TopspinMessagesRefused" for name, *_ in api.firing())
        with closing(open_zenoh(ZenohConfig(endpoint=endpoint, connect_timeout_s=10.0))) as stranger:
            stranger.request(Keys("r").rollout("9"), b"rubbish", 5.0, Flow.ROLLOUT).wait()
        refused = ("TopspinMessagesRefused", "learner", "0")
        wait_until(lambda: refused in api.firing(), 60, "its alarm")


def test_each_alarm_fires_when_its_cause_is_made(tmp_path):
    port, metrics = free_port(), free_port()
    flags = ("--run", "r", "--actors", 2, "--endpoint", f"tcp/127.0.0.1:{port}", *TINY)
    sick = (
        *("--learner.curriculum.stage-1", 10**9, "--learner.checkpoint-interval-s", 2),
        *("--learner.intake.target-lag", 6, "--learner.intake.max-lag", 8),  # TopspinActorsLag
        *("--learner.divergence.collapse", 0.99, "--learner.divergence.patience", 1),  # TopspinDiverged
        *("--learner.divergence.least", 0.01, "--watchdog-s", 0),
    )
    wire_port = free_port()
    wire = SlowWire(wire_port, "127.0.0.1", port)
    misfit = (  # TopspinMisfitActors, and by its rare heartbeats TopspinServiceHangs
        *("--run", "r", "--id", "odd", "--index", 7, "--endpoint", f"tcp/127.0.0.1:{wire_port}"),
        *("--network.units", "16,16", "--envs", 16, "--status-interval-s", 15, "--metrics-port", metrics),
    )
    target = {"targets": [f"127.0.0.1:{metrics}"], "labels": {"run": "r", "role": "actor", "id": "odd"}}
    (tmp_path / "more.json").write_text(json.dumps([target]))
    seen = set()
    shorter = [
        ("> 180", "> 8"),
        ('topspin_frames_total{role="learner"}[5m]', 'topspin_frames_total{role="learner"}[8s]'),
    ]
    with (
        closing(wire),
        running(tmp_path, "deploy.local", *flags, *sick),
        running(tmp_path, "services.actor", *misfit) as odd,
        prometheus_of(tmp_path, shorter) as api,
    ):

        def fires(*names, again=lambda: None):
            """Return whether all of these have fired; ``again`` makes their cause."""
            again()
            time.sleep(1.0)
            seen.update(name for name, *_ in api.all_firing())
            return seen.issuperset(names)

        def wait_for(*names, again=lambda: None):
            wait_until(lambda: fires(*names, again=again), 60, lambda: f"{set(names) - seen}")

        wait_until(lambda: api.health().get(("actor", "odd")) == "up", 120, "all to start")
        wait_until(lambda: len(players(tmp_path)) == 2, 120, "the run's actors")
        (learner,) = children_of(tmp_path, "learner").values()
        (generator,) = children_of(tmp_path, "generator").values()
        wait_for("TopspinActorsLag", "TopspinMisfitActors", "TopspinServiceHangs", "TopspinDiverged")

        def cut():
            wire.cut()
            time.sleep(2.0)  # the service notes that its link is back

        wait_for("TopspinLinkUnstable", again=cut)
        handles = psutil.Process(odd.process.pid).num_fds()
        resource.prlimit(odd.process.pid, resource.RLIMIT_NOFILE, (handles + 4, handles + 4))
        wait_for("TopspinFilesRunOut")
        odd.process.kill()
        wait_for("TopspinServiceDown")
        resource.prlimit(learner.pid, resource.RLIMIT_FSIZE, (1024, resource.RLIM_INFINITY))
        wait_for("TopspinSavesFail")
        resource.prlimit(learner.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        generator.suspend()
        wait_for("TopspinNoRallies")
        generator.resume()
        with closing(
            open_zenoh(ZenohConfig(endpoint=f"tcp/127.0.0.1:{port}", connect_timeout_s=10.0))
        ) as stranger:
            stranger.request(Keys("r").rollout("9"), b"rubbish", 5.0, Flow.ROLLOUT).wait()
        wait_for("TopspinMessagesRefused")
        one, *others = players(tmp_path)

        def pause_one():
            one.suspend()
            time.sleep(2.0)
            one.resume()

        wait_for("TopspinRolloutsTooOld", again=pause_one)
        for actor in (one, *others):
            actor.suspend()
        wait_for("TopspinNoActors", "TopspinNotTraining", "TopspinNotSaved")
        for actor in (one, *others):
            actor.resume()
        learner.kill()  # what it accepted after its last checkpoint is lost
        wait_for("TopspinRolloutsLost")

    assert seen == {alarm.name for alarm in alarms.ALARMS}


def players(folder):
    """Return the run's actors; neither the spare one that waits for a place, nor the misfit, has a --config."""
    return [process for process in children_of(folder, "actor").values() if "--config" in process.cmdline()]
