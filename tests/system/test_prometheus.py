"""A real Prometheus beside a run of real processes, with the settings and rules of deploy/monitoring."""

import json
import shutil
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from contextlib import closing, contextmanager

import pytest
import yaml

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

    def firing(self):
        """Return name, role and id of each alarm that stands, without those that a busy machine raises."""
        found = [alert for alert in self.get("alerts")["alerts"] if alert["state"] == "firing"]
        found = [alert for alert in found if alert["labels"]["alertname"] not in OF_A_BUSY_MACHINE]
        return {(a["labels"]["alertname"], a["labels"]["role"], a["labels"]["id"]) for a in found}


@contextmanager
def prometheus_of(folder):
    """Yield a Prometheus that watches the run in ``folder``; its intervals and waits are shortened to 1 s."""
    rules, config, port = alarms.rules(), prometheus(), free_port()
    for group in rules["groups"]:
        group["interval"] = "1s"
        for rule in group["rules"]:
            rule.pop("for", None)
    config["global"] = {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"}
    config["rule_files"] = [str(folder / "alerts.yml")]
    (discovery,) = config["scrape_configs"][0]["file_sd_configs"]
    discovery |= {"files": [str(folder / "runs/latest/targets.json")], "refresh_interval": "1s"}
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
        running(tmp_path, "deploy.local", *flags, "--learner.curriculum.stage-3", 100_000),
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
