"""The evaluator of a run: what it keeps, how often it asks, and which policies it refuses."""

import time

import numpy as np

from common.policy.folder import load_policy, save_policy
from common.task.config import TaskConfig
from services.evaluator import service as evaluator_service
from tests.integration.in_process_run import LONG, local_run, progress
from tests.waiting import wait_until


def test_a_restarted_evaluator_keeps_its_best_policy(tmp_path):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        s.actor(0, shards=1)
        evaluator = s.evaluator()
        wait_until(
            lambda: progress(learner).stage == 3 and evaluator.service.evaluations > 1, 60, "an evaluation"
        )
        folder = tmp_path / "policy" / "best"
        wait_until(folder.exists, 10, "a best policy")
        s.take_down(evaluator)
        best = load_policy(folder)
        measures = best.contract.measures | {
            "return_rate": 1.0,
            "target_error_mean": 0.0,
        }  # the best possible
        unbeaten = best.contract.model_copy(update={"stage": 3, "measures": measures})
        save_policy(folder, best.network, best.moments, unbeaten)
        again = s.evaluator()
        wait_until(lambda: again.service.evaluations >= 2, 30, "evaluations of the next life")
        s.take_down(again)
        kept = load_policy(folder).contract

    assert kept == unbeaten


def test_an_evaluator_asks_less_often_once_nothing_new_has_come_for_long(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluator_service, "QUIET_AFTER_S", 1.0)
    monkeypatch.setattr(evaluator_service, "QUIET_PAUSE_S", 2.0)
    asked = []
    with local_run(tmp_path, curriculum=LONG) as s:
        s.learner()
        evaluator = s.evaluator(run=False, interval_s=30.0)
        request = evaluator.transport.request
        monkeypatch.setattr(
            evaluator.transport,
            "request",
            lambda *given: (asked.append(time.monotonic()), request(*given))[1],
        )
        evaluator.start()
        wait_until(lambda: any(np.diff(asked) > 2.0), 30, "a long pause")

    assert np.diff(asked)[-1] > 2.0


def test_an_evaluator_of_another_task_refuses_the_policy_as_actors_do(tmp_path, caplog):
    """The shapes fit: the evaluator would play with other settings than the policy's, and save a wrong contract."""
    with local_run(tmp_path, curriculum=LONG) as s:
        s.learner()
        other = s.evaluator(task=TaskConfig(control_rate_hz=100))
        wait_until(lambda: other.metric("topspin_messages_refused_total", kind="policy") > 0, 30, "a refusal")

    assert other.service.evaluations == 0
    assert "start both with the same [task], [network] and [experience] settings" in caplog.text
    assert not (tmp_path / "policy" / "best").exists()
