import urllib.request

import pytest

from common.service.metrics import METRICS, Metrics, MetricsError


def test_names_have_the_suffixes_that_prometheus_expects():
    for metric in METRICS.values():
        assert metric.name.startswith("topspin_")
        assert metric.name.endswith("_total") == (metric.kind == "counter")
        assert metric.help[0].isupper()
        assert set(metric.roles) <= {"generator", "actor", "learner", "evaluator"}
        assert len(metric.labels) <= 2


def test_every_role_is_up_and_may_raise_and_set_its_own():
    for role in ("generator", "actor", "learner", "evaluator"):
        metrics = Metrics(role, "0")

        assert metrics.value("topspin_process_up", role=role, id="0") == 1.0


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
    services = [Metrics("actor", "0"), Metrics("actor", "1")]
    for number, metrics in enumerate(services):
        metrics.set("topspin_stage", number + 1)

    texts = []
    for metrics in services:
        with urllib.request.urlopen(f"http://127.0.0.1:{metrics.serve(0)}/metrics", timeout=5) as response:
            texts.append(response.read().decode())
        metrics.close()
        metrics.close()

    assert "topspin_stage 1.0" in texts[0]
    assert "topspin_stage 2.0" in texts[1]
    assert "# HELP topspin_rally_buffer_depth Rallies in stock [rallies]" in texts[0]


def test_a_taken_port_is_one_clear_line():
    first = Metrics("actor", "0")
    port = first.serve(0)

    with pytest.raises(MetricsError, match=f"can't serve metrics at 127.0.0.1:{port}: .*in use; choose"):
        Metrics("actor", "1").serve(port)

    first.close()
