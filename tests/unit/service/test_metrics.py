import contextlib
import http.client
import re
import urllib.request

import pytest

from common.service.endpoint import HANGS_AFTER_S, PORTS_TRIED, PortError
from common.service.metric_table import METRICS, OWN_LABELS
from common.service.metrics import Metrics, MetricsError


def test_names_have_the_suffixes_that_prometheus_expects():
    for metric in METRICS.values():
        assert metric.name.startswith("topspin_")
        assert metric.name.endswith("_total") == (metric.kind == "counter")
        assert metric.help[0].isupper()
        assert set(metric.roles) <= {"generator", "actor", "learner", "evaluator", "router"}
        assert len(metric.labels) <= 2
        assert not set(metric.labels) & set(OWN_LABELS)  # one of these would hide the service's own


def test_every_role_is_up_and_may_raise_and_set_its_own():
    for role in ("generator", "actor", "learner", "evaluator"):
        metrics = Metrics(role, "0")

        assert metrics.value("topspin_process_up") == 1.0


def test_counters_rise_gauges_are_set_and_labels_are_separate():
    metrics = Metrics("learner", "0")
    metrics.inc("topspin_rollouts_received_total", verdict="accepted")
    metrics.inc("topspin_rollouts_received_total", 2.0, verdict="busy")
    metrics.set("topspin_stage", 3)

    assert metrics.value("topspin_rollouts_received_total", verdict="accepted") == 1.0
    assert metrics.value("topspin_rollouts_received_total", verdict="busy") == 2.0
    assert metrics.value("topspin_stage") == 3.0


def test_a_counter_follows_a_total_that_is_counted_elsewhere():
    metrics = Metrics("actor", "0")
    for total in (3, 3, 10):
        metrics.follow("topspin_rallies_consumed_total", total)

    assert metrics.value("topspin_rallies_consumed_total") == 10.0


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda metrics: metrics.set("topspin_spam", 1), "the actor has no metric 'topspin_spam'"),
        (lambda metrics: metrics.set("topspin_kl", 1), "the actor has no metric 'topspin_kl'"),
        (lambda metrics: metrics.inc("topspin_stage"), "topspin_stage is a gauge, not a counter"),
        (lambda metrics: metrics.observe("topspin_stage", 1), "topspin_stage is a gauge, not a histogram"),
        (lambda metrics: metrics.set("topspin_stage", 1, x="y"), r"labels \['x'\]; allowed: \[\]"),
        (
            lambda metrics: metrics.inc("topspin_rollouts_refused_total"),
            r"labels \[\]; allowed: \['reason'\]",
        ),
    ],
)
def test_an_unknown_metric_kind_or_label_is_refused(use, message):
    with pytest.raises(MetricsError, match=message):
        use(Metrics("actor", "0"))


def test_several_services_of_one_process_have_separate_metrics():
    services = [Metrics("actor", "0", "night"), Metrics("actor", "1", "night")]
    for number, metrics in enumerate(services):
        metrics.set("topspin_stage", number + 1)

    texts = []
    for metrics in services:
        with urllib.request.urlopen(f"http://127.0.0.1:{metrics.serve(0)}/metrics", timeout=5) as response:
            texts.append(response.read().decode())
        metrics.close()
        metrics.close()

    assert 'topspin_stage{id="0",role="actor",run="night"} 1.0' in texts[0]
    assert 'topspin_stage{id="1",role="actor",run="night"} 2.0' in texts[1]
    assert "# HELP topspin_stage Stage of the curriculum [1]" in texts[0]


def samples(metrics):
    return [line for line in metrics.text().decode().splitlines() if not line.startswith("#")]


def test_every_sample_names_run_role_and_id_those_of_process_and_gc_too_and_none_is_a_time_of_creation():
    metrics = Metrics("learner", "0", "night")
    metrics.observe("topspin_update_seconds", 0.2)

    lines = samples(metrics)

    for name in ("process_resident_memory_bytes", "process_open_fds", "python_gc_collections_total"):
        assert any(line.startswith(name) for line in lines), name
    assert [
        line for line in lines if not {'run="night"', 'role="learner"'} <= set(re.split("[{},]", line))
    ] == []
    assert not any("_created" in line for line in lines)


def test_a_gauge_is_exported_from_its_first_value_on_and_a_counter_from_the_start():
    metrics = Metrics("learner", "0")
    before = samples(metrics)
    metrics.set("topspin_kl", 0.0)
    after = samples(metrics)

    assert not any(line.startswith("topspin_kl") for line in before)
    assert any(line.startswith("topspin_rollbacks_total") for line in before)
    assert any(line.startswith("topspin_kl") for line in after)


def test_a_taken_port_gives_way_to_the_next_free_one():
    first, second = Metrics("actor", "0"), Metrics("actor", "1")
    port = first.serve(0)
    other = second.serve(port)
    first.close()
    second.close()

    assert port < other <= port + PORTS_TRIED


def test_an_address_of_another_machine_is_one_clear_line():
    with pytest.raises(PortError, match=r"can't serve metrics at 192\.0\.2\.1:9100: .*; choose another"):
        Metrics("actor", "0").serve(9100, "192.0.2.1")


def ask(port, path):
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=5)) as connection:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.read().decode().strip()


def test_a_service_is_well_while_its_main_loop_turns_and_ready_while_it_has_joined_and_is_linked():
    metrics = Metrics("actor", "0")
    port, health = metrics.serve(0), metrics.health

    assert ask(port, "/healthz") == (503, "the main loop has not begun")
    assert ask(port, "/readyz") == (503, "not a member of the run")
    health.turn()
    health.has_joined = True
    assert ask(port, "/healthz") == ask(port, "/readyz") == (200, "ok")
    health.is_linked = False
    assert ask(port, "/readyz") == (503, "no link to the hub")
    health.turned -= HANGS_AFTER_S + 1.0
    assert ask(port, "/healthz") == (503, "the main loop has not turned for 61 s")
    assert ask(port, "/")[0] == 404
    metrics.close()
