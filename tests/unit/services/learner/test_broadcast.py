"""What the learner answers who asks for its policy, also within an update."""

import pytest
import torch
from safetensors.torch import load

from common.comms.codec import decode
from common.comms.keys import Keys
from common.comms.memory_transport import MemoryBroker
from common.comms.messages import AVERAGE, PolicySnapshot
from common.comms.transport import Flow
from services.learner.broadcast import Broadcast, Identity
from tests.unit.services.learner.test_training import PPO, dataset, make_training


@pytest.mark.parametrize("evaluated", ["mean", "newest"])
def test_the_evaluator_gets_a_whole_version_within_an_update(evaluated):
    broker, keys, training = MemoryBroker(), Keys("r"), make_training()
    hub, evaluator = broker.open(hub=True), broker.open()
    broadcast = Broadcast(hub, keys, training, Identity("r", 1, "c", "t"), evaluated=evaluated)

    def asked():
        pending = evaluator.request(keys.policy(), AVERAGE, 5.0, Flow.POLICY)
        broadcast.answer()
        return pending.wait().payload

    training.run_epoch(dataset(0))
    broadcast.publish_policy()
    before, within = asked(), []
    training.run_epoch(dataset(1), lambda: within.append(asked()))
    broadcast.publish_policy()

    assert len(within) > 2
    assert set(within) == {before}
    assert asked() != before


@pytest.mark.parametrize("evaluated", ["mean", "newest"])
def test_actors_get_weights_as_updates_compute_and_the_evaluator_gets_all_bits(evaluated):
    broker, keys = MemoryBroker(), Keys("r")
    training = make_training(ppo=PPO.model_copy(update={"precision": "bfloat16"}))
    hub, member = broker.open(hub=True), broker.open()
    broadcast = Broadcast(hub, keys, training, Identity("r", 1, "c", "t"), evaluated=evaluated)
    training.run_epoch(dataset(0))
    broadcast.publish_policy()

    def asked(payload):
        pending = member.request(keys.policy(), payload, 5.0, Flow.POLICY)
        broadcast.answer()
        return load(decode(pending.wait().payload, PolicySnapshot).weights)

    acting, evaluation = asked(b""), asked(AVERAGE)
    whole = (training.average if evaluated == "mean" else training.network).state_dict()
    for name, value in training.network.state_dict().items():
        assert torch.equal(acting[name], value.bfloat16() if value.ndim == 2 else value)
        assert torch.equal(evaluation[name], whole[name])
