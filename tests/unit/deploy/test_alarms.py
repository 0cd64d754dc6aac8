"""Alarms and dashboard: every name in them exists, every alarm fires by its cause, and none on a healthy run.

Prometheus itself answers, where Debian's package is installed; `tests/system/test_prometheus.py` asks a live run.
"""

import re
import shutil
import subprocess

import pytest
import yaml

from common.service.metric_table import METRICS, OWN_LABELS
from deploy.manifests.alarms import ALARMS, WAIT_SHARE, WAIT_SHARE_QUERY
from deploy.manifests.files import FOLDER
from deploy.manifests.panels import dashboard, expressions

BUILT_IN = {  # names that Prometheus and its client give, with their labels
    "up": {"job"},
    "process_open_fds": set(),
    "process_max_fds": set(),
    "process_cpu_seconds_total": set(),
    "process_resident_memory_bytes": set(),
}
WORDS = {
    *(
        "rate",
        "increase",
        "delta",
        "sum",
        "avg",
        "by",
        "without",
        "time",
        "avg_over_time",
        "histogram_quantile",
    ),
}
promtool = pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed")

OWN = 'run="r",role="learner",id="0"'


def series(name, values, labels=""):
    return {"series": f"{name}{{{OWN}{labels}}}", "values": values}


HEALTHY = {
    "up": series("up", "1x100", ',job="topspin"'),
    "heartbeat": series("topspin_heartbeat_time_seconds", "0+15x100"),
    "actors": series("topspin_alive", "2x100", ',service="actor"'),
    "frames": series("topspin_frames_total", "0+8192x100"),
    "update": series("topspin_phase_seconds_total", "0+12x100", ',phase="update"'),
    "checkpoint": series("topspin_checkpoint_time_seconds", "0x3 45x3 105x3 165x3 225x3 285x3 345+15x80"),
    "saves": series("topspin_failed_saves_total", "0x100"),
    "lost": series("topspin_ledger_rollouts", "0x100", ',fate="lost"'),
    "rollbacks": series("topspin_rollbacks_total", "0x100"),
    "lag": series("topspin_policy_lag", "0.6x100"),
    "old": series("topspin_rollouts_received_total", "0x100", ',verdict="too_old"'),
    "misfits": series("topspin_misfit_actors", "0x100"),
    "refused": series("topspin_messages_refused_total", "0x100", ',kind="rollout"'),
    "underruns": series("topspin_rally_underruns_total", "0x100"),
    "reconnects": series("topspin_reconnects_total", "0x20 1x80"),  # once is no alarm
    "open": series("process_open_fds", "60x100"),
    "most": series("process_max_fds", "1024x100"),
}
CAUSES = {  # what changes, at 15 s a value
    "TopspinServiceDown": ("up", "1x60 0x40"),
    "TopspinServiceHangs": ("heartbeat", "0+15x60 900x40"),
    "TopspinNoActors": ("actors", "2x60 0x40"),
    "TopspinNotTraining": ("frames", "0+8192x40 327680x60"),
    "TopspinNotSaved": ("checkpoint", "0+15x60 900x40"),
    "TopspinSavesFail": ("saves", "0x70 1x30"),
    "TopspinRolloutsLost": ("lost", "0x70 2x30"),
    "TopspinDiverged": ("rollbacks", "0x70 1x30"),
    "TopspinActorsLag": ("lag", "0.6x40 3x60"),
    "TopspinRolloutsTooOld": ("old", "0x70 5x30"),
    "TopspinMisfitActors": ("misfits", "0x60 1x40"),
    "TopspinMessagesRefused": ("refused", "0x70 1x30"),
    "TopspinNoRallies": ("underruns", "0x40 0+5x60"),
    "TopspinLinkUnstable": ("reconnects", "0x60 0+1x40"),
    "TopspinFilesRunOut": ("open", "60x60 900x40"),
}
MOMENT = "24m"


def all_expressions():
    return [*(alarm.expression for alarm in ALARMS), WAIT_SHARE_QUERY, *expressions()]


def known_labels(name):
    plain = re.sub(r"_(bucket|sum|count)$", "", name)
    if name in BUILT_IN:
        return BUILT_IN[name] | set(OWN_LABELS)
    assert name in METRICS or METRICS[plain].kind == "histogram", name
    return {*METRICS.get(name, METRICS[plain]).labels, *OWN_LABELS}


def test_of_a_group_of_learners_the_one_that_leads_is_asked():
    """The others count no frames, so their rate is 0 for ever."""
    asked = [expression for expression in all_expressions() if 'role="learner"' in expression]

    assert len(asked) > 5
    assert all('role="learner",id="0"' in expression for expression in asked)


def test_every_metric_and_label_of_every_expression_is_in_the_table():
    for expression in all_expressions():
        found = re.findall(r"([a-z_]+)(?:\{([^}]*)\})?", re.sub(r"\[\w+\]|\"[^\"]*\"", "", expression))
        names = [
            (name, labels)
            for name, labels in found
            if name.startswith(("topspin_", "process_")) or name == "up"
        ]

        assert names, expression
        for name, labels in names:
            assert set(re.findall(r"(\w+)=", labels)) <= known_labels(name), expression


def test_a_role_that_an_expression_names_has_the_metric():
    for expression in all_expressions():
        for name, role in re.findall(r'(topspin_\w+)\{[^}]*role="(\w+)"', expression):
            assert role in METRICS[re.sub("_bucket$", "", name)].roles, expression


def test_every_alarm_has_a_cause_here_and_an_action():
    assert [alarm.name for alarm in ALARMS] == list(CAUSES)
    assert all(alarm.action.endswith(".") for alarm in ALARMS)


def test_panels_do_not_overlap_and_stay_inside_the_grid():
    taken = set()
    for panel in dashboard()["panels"]:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert place["x"] + place["w"] <= 24
        taken |= cells


def rule_test(name, changed, firing):
    """Return a test of promtool: which alarms stand at `MOMENT` when one series is changed."""
    given = (
        HEALTHY if changed is None else HEALTHY | {changed[0]: HEALTHY[changed[0]] | {"values": changed[1]}}
    )
    expected = [{"labels": f'{{alertname="{name}"}}', "value": 1}] if firing else []
    query = 'count by (alertname) (ALERTS{alertstate="firing"})'
    return {
        "name": name,
        "interval": "15s",
        "input_series": list(given.values()),
        "promql_expr_test": [{"expr": query, "eval_time": MOMENT, "exp_samples": expected}],
    }


@promtool
def test_each_alarm_fires_alone_by_its_cause_and_none_on_a_healthy_run(tmp_path):
    tests = [rule_test("healthy", None, firing=False)]
    tests += [rule_test(name, change, firing=True) for name, change in CAUSES.items()]
    hunger = {
        "interval": "15s",
        "input_series": list(HEALTHY.values()),
        "promql_expr_test": [
            {
                "expr": f"round({WAIT_SHARE}, 0.01)",
                "eval_time": MOMENT,
                "exp_samples": [{"labels": f'{{{OWN},phase="update"}}', "value": 0.2}],
            }
        ],
    }
    file = tmp_path / "test.yml"
    rules = {"rule_files": [str(FOLDER / "monitoring/alerts.yml")], "evaluation_interval": "15s"}
    file.write_text(yaml.safe_dump(rules | {"tests": [*tests, hunger]}))

    done = subprocess.run(["promtool", "test", "rules", file], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stdout + done.stderr


@promtool
def test_prometheus_accepts_its_settings_and_rules():
    done = subprocess.run(
        ["promtool", "check", "config", FOLDER / "monitoring/prometheus.yml"],
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stdout + done.stderr
