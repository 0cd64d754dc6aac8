"""What a contract says about its policy."""

import pytest

from common.policy.config import NetworkConfig
from common.policy.contract import PolicyError, contract_of
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.observation import PAPER_OBSERVATION


@pytest.mark.parametrize(
    ("options", "is_end_to_end"),
    [
        ({}, True),
        ({"history": 8}, True),
        ({"age": True}, True),
        ({"critic": "privileged"}, True),  # the policy does not observe the truth
        ({"prediction": True}, False),
        ({"spin": "estimated"}, False),
        ({"spin": "true"}, False),
        ({"ball": "filtered"}, False),
    ],
)
def test_a_policy_that_is_fed_a_prediction_spin_or_a_filtered_ball_is_not_end_to_end(options, is_end_to_end):
    task = TaskConfig(observation=PAPER_OBSERVATION.model_copy(update=options))
    contract = contract_of(
        task, ExperienceConfig(), NetworkConfig(), run="r", generation=1, version=1, stage=3, frames=1
    )

    assert contract.is_end_to_end == is_end_to_end


def test_an_expected_spin_is_refused_where_nothing_observed_depends_on_it():
    where = {"generation": 1, "version": 1, "stage": 3, "frames": 1}
    task = TaskConfig(observation=PAPER_OBSERVATION)
    contract = contract_of(task, ExperienceConfig(), NetworkConfig(), run="r", **where)

    assert contract.expecting("contract") is contract
    with pytest.raises(PolicyError, match="expected_spin 'strong' for a policy without a flight filter"):
        contract.expecting("strong")
