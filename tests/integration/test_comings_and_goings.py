"""Services that start late, die, return or are missing: no service waits for ever, and the ledger balances."""

import logging
import threading
import time

import numpy as np
import pytest
import torch

from common.comms.messages import VerdictKind
from common.comms.transport import TransportError
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.policy.config import NetworkConfig
from common.policy.folder import load_policy
from services.actor.rally_feed import NoRalliesError
from services.actor.service import LifeEndedError
from services.learner.checkpoint import CheckpointError
from services.learner.config import IntakeConfig
from services.learner.service import RunExistsError
from tests.integration.in_process_run import CURRICULUM, DATASET, LONG, free_endpoint, local_run, progress
from tests.waiting import wait_until

SYNCHRONOUS = {"intake": IntakeConfig(dataset_rollouts=2, max_lag=0)}


def state_of(training):
    """Return everything that decides further training, as arrays."""
    state = {f"network.{name}": value.numpy().copy() for name, value in training.network.state_dict().items()}
    for index, values in training.optimizer.state_dict()["state"].items():
        state |= {f"adam.{index}.{name}": value.numpy().copy() for name, value in values.items()}
    for name in ("obs_moments", "value_moments"):
        moments = getattr(training, name)
        state |= {f"{name}.{part}": np.array(getattr(moments, part)) for part in ("mean", "var", "count")}
    state["shuffle"] = training.generator.get_state().numpy().copy()
    return state


def assert_same_state(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


def test_an_actor_that_starts_late_gets_policy_and_stage_and_takes_part(tmp_path):
    with local_run(tmp_path, curriculum=CURRICULUM.model_copy(update={"stage_2": 500 * DATASET})) as s:
        learner = s.learner()
        s.generator()
        first = s.actor(0)
        wait_until(lambda: progress(learner).stage == 2, 60, "stage 2")
        late = s.actor(1)
        wait_until(lambda: late.service.counts.accepted >= 2, 30, "the late actor's rollouts")
        seen = (late.metric("topspin_stage"), late.metric("topspin_policy_version"))
        first.end()
        late.end()
        learner.end()
        refused = late.service.counts.refused

    assert seen[0] == 2
    assert seen[1] >= 3
    assert refused == {}
    assert learner.service.ledger().lost == 0
    assert learner.service.ledger().balance == 0


def test_the_checkpoint_time_of_a_new_learner_is_its_start_and_not_1970(tmp_path):
    started = time.time()
    with local_run(tmp_path) as s:
        waiting = s.learner(run=False).metric("topspin_checkpoint_time_seconds")

    assert started <= waiting <= time.time()


def test_a_killed_actors_rollouts_are_accounted_for_and_the_others_train_on(tmp_path):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        victim, other = s.actor(0), s.actor(1)
        wait_until(lambda: victim.service.counts.accepted >= 4, 60, "some rollouts")
        s.cut_off(victim)
        wait_until(lambda: learner.metric("topspin_alive", service="actor") == 1, 10, "the learner to notice")
        epoch = progress(learner).epoch
        wait_until(lambda: progress(learner).epoch >= epoch + 4, 30, "training to go on")
        again = s.actor(0)
        wait_until(lambda: again.service.counts.accepted >= 2, 30, "its next life")
        other.end()
        again.end()
        learner.end()
        ledger = learner.service.ledger()
        published = sum(entry.service.counts.published for entry in (victim, other, again))

    assert ledger.balance == 0
    # rollouts that it numbered and never sent are unknown to the learner
    assert published - 2 <= ledger.published <= published
    assert ledger.lost <= 2
    assert ledger.refused == {}


def test_a_restarted_learner_continues_from_its_checkpoint_and_its_actors_follow(tmp_path):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        actors = [s.actor(0), s.actor(1)]
        wait_until(lambda: progress(learner).epoch >= 7, 60, "stage 3")
        s.take_down(learner)
        before, trained = learner.service.training, learner.service.ledger().trained

        again = s.learner(run=False, resume=True)
        after = again.service.training
        assert after.progress == before.progress
        assert_same_state(state_of(before), state_of(after))
        assert again.service.ledger().trained == trained
        again.start()
        wait_until(lambda: after.progress.epoch >= before.progress.epoch + 4, 30, "training to go on")
        for actor in actors:
            wait_until(
                lambda a=actor: a.metric("topspin_policy_version") > before.progress.version, 10, "its policy"
            )
            actor.end()
        again.end()
        ledger = again.service.ledger()
        counts = [actor.service.counts for actor in actors]
        reconnects = [actor.metric("topspin_reconnects_total") for actor in actors]

    assert ledger.balance == 0
    assert (
        ledger.trained == 2 * after.progress.epoch
    )  # a rollout that was trained twice would be one too many
    assert ledger.published == sum(count.published for count in counts)
    assert all(count.balance == 0 and count.in_flight == 0 for count in counts)
    assert set(ledger.refused) <= {VerdictKind.WRONG_GENERATION}
    assert min(reconnects) >= 1


def test_a_planned_stop_and_resume_lose_nothing(tmp_path):
    """Rollouts that wait at the stop are kept and trained: `lost` is an alarm."""
    with local_run(tmp_path, curriculum=LONG, intake=IntakeConfig(dataset_rollouts=3)) as s:
        learner = s.learner()
        s.generator()
        actors = [s.actor(0), s.actor(1)]
        wait_until(lambda: progress(learner).epoch >= 3, 60, "training")
        for actor in actors:
            actor.end()
        wait_until(lambda: learner.service._intake.queued < 3, 10, "less than a dataset to wait")
        s.take_down(learner)
        stopped = learner.service.ledger()
        again = s.learner(resume=True)
        resumed = again.service.ledger()
        actors = [s.actor(0), s.actor(1)]
        epoch = progress(again).epoch
        wait_until(lambda: progress(again).epoch >= epoch + 3, 60, "training to go on")
        for actor in actors:
            actor.end()
        again.end()
        ledger = again.service.ledger()

    assert (stopped.lost, resumed.lost, ledger.lost) == (0, 0, 0)
    assert resumed.in_flight == stopped.in_flight
    assert ledger.balance == 0
    assert ledger.refused == {}
    assert ledger.trained == 3 * progress(again).epoch


def test_an_actor_whose_life_is_closed_ends_so_that_a_new_one_is_started(tmp_path, monkeypatch):
    """Such as after a day without a link. It would wait for credits for ever, and look well."""
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        actor = s.actor(0, run=False)
        wait_until(
            lambda: actor.service.step(time.monotonic()) and actor.service.counts.accepted, 60, "a verdict"
        )
        reason = "life 7 of actor 0 ended, and its account is closed: start the actor again"
        monkeypatch.setattr(learner.service._intake._accounts, "closed_reason", lambda life: reason)

        with pytest.raises(LifeEndedError, match=reason):
            wait_until(lambda: actor.service.step(time.monotonic()) < 0.0, 60, "the end")


def test_an_actor_that_leaves_sends_its_unanswered_rollouts(tmp_path):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        actor = s.actor(0, run=False)

        def plays_until(condition):
            def is_so():
                actor.service.step(time.monotonic())
                return condition()

            return is_so

        wait_until(plays_until(lambda: actor.service.counts.accepted >= 1), 60, "a first verdict")
        s.take_down(learner)
        wait_until(plays_until(lambda: actor.metric("topspin_rollouts_retried_total") >= 3), 20, "a retry")
        assert actor.service.counts.in_flight > 0
        again = s.learner(resume=True)
        wait_until(lambda: actor.transport.connected, 20, "the link")
        actor.service.leave()
        left = actor.service.counts
        again.end()
        ledger = again.service.ledger()

    assert left.in_flight == left.balance == 0
    assert ledger.balance == 0
    # what the first learner accepted and did not train still waits: its checkpoint kept it
    assert ledger.in_flight == left.accepted - ledger.trained
    assert ledger.lost == 0
    assert ledger.published == left.published


@pytest.mark.parametrize(
    ("budget", "spent"), [({"frames": 2048}, "2,048 of 2,048 frames"), ({"minutes": 0.02}, "of 0.02 minutes")]
)
def test_a_resumed_learner_with_a_spent_budget_logs_it_and_trains_nothing(tmp_path, caplog, budget, spent):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner(**budget)
        s.generator()
        actors = [s.actor(0), s.actor(1)]
        learner.join(60)
        s.take_down(learner)
        again = s.learner(resume=True, **budget)
        again.join(30)
        for actor in actors:
            actor.end()
        trained = progress(learner).epoch, progress(again).epoch

    assert trained[0] == trained[1] > 0
    assert f"{spent} are trained, through all restarts; raise --minutes or --frames" in caplog.text


def test_a_second_run_does_not_overwrite_the_first_ones_checkpoints(tmp_path):
    with local_run(tmp_path) as s:
        s.take_down(s.learner())
        with pytest.raises(RunExistsError, match="go on with --resume, or choose another --run"):
            s.learner()


def test_a_resume_that_does_not_fit_leaves_the_runs_settings_as_they_were(tmp_path):
    with local_run(tmp_path) as s:
        s.take_down(s.learner())
        before = (tmp_path / "config.toml").read_text()
        with pytest.raises(CheckpointError, match="doesn't fit this configuration"):
            s.learner(resume=True, network=NetworkConfig(units=(8, 8)))

    assert (tmp_path / "config.toml").read_text() == before


def synchronous_run(folder, gate=0.0):
    with local_run(folder, curriculum=CURRICULUM.model_copy(update={"catch_gate": gate}), **SYNCHRONOUS) as s:
        learner = s.learner()
        s.generator(shards=1)
        actor = s.actor(shards=1, rallies="ask")
        learner.join(60)
        actor.end()
        return learner.service, actor.service


def test_a_seeded_synchronous_run_is_reproducible_bit_for_bit(tmp_path):
    one, actor = synchronous_run(tmp_path / "one")
    other, _ = synchronous_run(tmp_path / "other")

    assert one.training.progress == other.training.progress
    assert one.training.progress.stage_number == 2
    assert_same_state(state_of(one.training), state_of(other.training))
    assert actor.counts.refused == {}
    assert one.ledger().lost == one.ledger().in_flight == 0
    assert actor._buffer.counts.underruns == 0
    contracts = [load_policy(tmp_path / name / "policy" / "latest") for name in ("one", "other")]
    weights = [torch.cat([p.flatten() for p in policy.network.parameters()]) for policy in contracts]
    assert torch.equal(*weights)


def test_a_gate_ends_a_stage_early_and_no_accepted_rollout_is_lost(tmp_path):
    curriculum = CURRICULUM.model_copy(update={"stage_1": 400 * DATASET, "catch_gate": 1e-6})
    with local_run(tmp_path, curriculum=curriculum, frames=20_000) as s:
        learner = s.learner()
        s.generator()
        actors = [s.actor(0, envs=32), s.actor(1, envs=32)]
        learner.join(90)
        for actor in actors:
            actor.end()
        ledger = learner.service.ledger()

    assert progress(learner).stage > 1
    assert progress(learner).epoch < 400
    assert ledger.balance == 0
    assert (ledger.lost, ledger.refused) == (0, {})


def test_a_reproducible_actor_names_the_missing_generator(tmp_path):
    with local_run(tmp_path, **SYNCHRONOUS) as s:
        learner = s.learner()
        generator = s.generator(shards=1, batch=1)
        actor = s.actor(shards=1, rallies="ask", rally_wait_s=1.0, envs=4)
        wait_until(lambda: actor.service.frames > 0, 60, "the first rollout")
        s.take_down(generator)
        with pytest.raises(
            NoRalliesError, match=r"no rally block \d+ of shard 0 in 1 s.*services\.generator"
        ):
            actor.join(60)
        learner.end()


def test_a_generator_idles_without_subscribers(tmp_path):
    with local_run(tmp_path) as s:
        s.learner()
        generator = s.generator()
        wait_until(
            lambda: generator.service.state == "idle" and generator.service._member._next_status > 0,
            10,
            "idleness",
        )
        silent = generator.scrape()["topspin_rallies_published_total"]
        subscription = s.peer().subscribe("topspin/v3/test/rally/1", capacity=8)
        assert subscription.wait(10.0)
        wait_until(lambda: generator.metric("topspin_rallies_published_total") >= 32, 10, "its first batch")
        subscription.close()
        wait_until(lambda: generator.service.state == "idle", 10, "idleness again")

    assert silent == 0


def test_without_a_learner_a_service_logs_its_wait_and_ends_with_one_line(caplog):
    endpoint = free_endpoint()
    with (
        caplog.at_level(logging.INFO),
        pytest.raises(
            TransportError, match=f"no hub answered at {endpoint} in 1 s: start the learner"
        ) as caught,
    ):
        open_zenoh(ZenohConfig(endpoint=endpoint, connect_timeout_s=1.0), threading.Event())

    assert "\n" not in str(caught.value)
    assert f"waiting for the hub endpoint={endpoint}" in caplog.text


def test_the_learner_logs_its_endpoint_and_the_command_that_starts_actors(tmp_path, caplog):
    with caplog.at_level(logging.INFO), local_run(tmp_path, silence_warning_s=0.1) as s:
        learner = s.learner()
        wait_until(lambda: "waiting for=actors" in caplog.text, 5, "the learner's warning")
        learner.end()

    assert f"listening endpoint={s.endpoint}" in caplog.text
    assert f"python -m services.actor --run test --endpoint {s.endpoint}" in caplog.text


def test_an_actor_that_runs_out_of_rallies_logs_it_once(tmp_path, caplog):
    curriculum = CURRICULUM.model_copy(update={"stage_1": 40 * DATASET, "stage_2": 0})
    with caplog.at_level(logging.INFO), local_run(tmp_path, curriculum=curriculum) as s:
        s.learner()
        s.generator(shards=1, batch=16, rate_hz=0.1)  # enough for the start, and then none
        actor = s.actor(shards=1)
        wait_until(lambda: "rallies run out" in caplog.text, 60, "the actor's warning")
        wait_until(
            lambda: actor.metric("topspin_rollouts_published_total") > 20, 60, "some more blocks to be played"
        )

    assert caplog.text.count("rallies run out") == 1
    assert "raise the generators' rate_hz, or add generators" in caplog.text
    assert actor.metric("topspin_rally_underruns_total") > 0


def test_rallies_that_an_idle_actor_lets_go_count_as_neither_dropped_nor_lost(tmp_path):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner(run=False)  # the hub; it answers nothing, so the actor is idle
        generator, actor = s.generator(), s.actor(0)
        feed = actor.service._feed
        wait_until(lambda: feed.unneeded >= 3, 30, "batches that the idle actor does not need")
        learner.start()
        wait_until(lambda: actor.service._buffer.counts.gaps >= 3, 60, "the gap that they leave")
        wait_until(lambda: actor.metric("topspin_rallies_consumed_total") > 0, 30, "a heartbeat")
        found = actor.scrape()
        for entry in (actor, generator, learner):
            entry.end()

    assert found["topspin_rally_gaps_total"] == 0
    assert not any(
        value for name, value in found.items() if name.startswith("topspin_messages_dropped_total")
    )
