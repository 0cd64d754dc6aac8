"""What the learner answers who asks for its policy, also within an update."""

import pytest

from common.comms.keys import Keys
from common.comms.memory_transport import MemoryBroker
from common.comms.messages import AVERAGE
from common.comms.transport import Flow
from services.learner.broadcast import Broadcast, Identity
from tests.unit.services.learner.test_training import dataset, make_training


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
