from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fuzz.message_examples import make_rollout
from benchmarks.play import make_training
from benchmarks.scale.fleet import _shares
from benchmarks.scale.senders import Sender, sent_by
from benchmarks.scale.sizes import new_training, policy_sizes, policy_snapshot, rollout_sizes
from common.comms.codec import decode, encode
from common.comms.keys import Keys
from common.comms.memory_transport import MemoryBroker
from common.comms.messages import ActorReport, Rollout
from common.comms.transport import Flow
from services.learner.admission import Header
from services.learner.config import PPOConfig
from tests.unit.services.accounting import LEARNER_STATE, make_intake, take_dataset

KEYS = Keys(LEARNER_STATE.run)


@pytest.fixture
def broker():
    return MemoryBroker()


def header_of(rollout: Rollout) -> Header:
    names = (
        "run",
        "generation",
        "version",
        "stage_number",
        "actor",
        "incarnation",
        "sequence",
        "training_hash",
    )
    return Header(**{name: getattr(rollout, name) for name in names})


def test_light_senders_keep_to_the_actors_protocol(broker):
    """A real intake grants them credits and accepts all that they send: versions, numbers and hashes are right."""
    hub, intake = broker.open(hub=True), make_intake(dataset_rollouts=4)
    rollouts, reports = hub.serve(KEYS.every_rollout(), 64), hub.serve(KEYS.every_report(), 64)
    senders = [Sender(f"s{i}", broker.open(), KEYS, make_rollout(), takes_policies=True) for i in range(3)]
    verdicts, version = [], LEARNER_STATE.version
    for turn in range(60):
        for sender in senders:
            sender.step(turn * 1.0)
        for request in reports.waiting(64):
            request.reply(encode(intake.report(decode(request.payload, ActorReport), turn * 1.0)))
        for request in rollouts.waiting(64):
            rollout = decode(request.payload, Rollout)
            verdict = intake.arrive(header_of(rollout), rollout, turn * 1.0)
            verdicts.append(verdict.kind.value)
            request.reply(encode(verdict))
        if dataset := take_dataset(intake):
            assert len(dataset) == 4
            version += 1
            intake.finish_update(replace(LEARNER_STATE, version=version))
    sent = sent_by(senders)

    assert set(verdicts) == {"accepted"}
    assert len(verdicts) >= 20
    assert (sent.ready, sent.refused) == (3, 0)
    assert sent.rollouts in (len(verdicts), len(verdicts) - 1, len(verdicts) - 2, len(verdicts) - 3)
    assert all(sender.counts.balance == 0 for sender in senders)


def test_a_light_sender_takes_policies_as_an_actor_does(broker):
    hub = broker.open(hub=True)
    takes, ignores = (
        Sender(name, broker.open(), KEYS, make_rollout(), takes_policies=name == "a") for name in ("a", "b")
    )
    hub.publish(KEYS.policy(), encode(policy_snapshot(new_training())), Flow.POLICY)
    takes.step(0.0)
    ignores.step(0.0)

    assert (takes.policies, ignores.policies) == (1, 0)


def test_the_bytes_of_all_fields_are_the_message():
    rollout = make_rollout()
    found = rollout_sizes(rollout)
    frames = rollout.rewards.size

    assert found["bytes_per_frame"] * frames == pytest.approx(len(encode(rollout)), abs=0.1 * frames)
    assert sum(found["bytes_per_frame_by_field"].values()) == pytest.approx(found["bytes_per_frame"], abs=0.1)
    assert found["bytes_per_frame_by_field"]["actions"] == 28.0


def test_observations_and_corrections_travel_in_two_bytes_a_number():
    rollout = make_rollout()
    found = rollout_sizes(rollout)
    of_field = found["bytes_per_frame_by_field"]

    assert of_field["obs"] == 2 * rollout.obs.shape[-1]
    assert of_field["corrections"] == 14.0
    assert 0.0 < found["float16_error_std_mean"] < found["float16_error_std_max"] < 0.01


@pytest.mark.parametrize(("precision", "saved"), [("float32", 0), ("bfloat16", 2)])
def test_a_policy_travels_in_the_precision_of_the_updates(precision, saved):
    training = make_training(PPOConfig(precision=precision), 0)
    found = policy_sizes(training)
    matrices = sum(value.numel() for value in training.network.state_dict().values() if value.ndim > 1)

    assert found["policy_bytes"] == len(encode(policy_snapshot(training)))
    assert found["policy_bytes_float32"] - found["policy_bytes"] == pytest.approx(saved * matrices, abs=100)
    assert found["policy_bytes_without_critic"] < found["policy_bytes"]


def test_senders_are_divided_evenly():
    assert _shares(10, 4) == [3, 3, 2, 2]
    assert np.sum(_shares(1000, 3)) == 1000
