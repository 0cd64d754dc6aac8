import pytest

from common.policy.contract import contract_of
from services.evaluator.best import is_comparable, match_of, score
from services.evaluator.config import EvaluatorConfig


def test_best_is_a_later_stage_then_a_percent_of_balls_against_a_centimetre():
    def found(catch, back, error):
        return {"catch_rate": catch, "return_rate": back, "target_error_mean": error}

    ranking = [
        score(1, found(0.2, 0.0, None)),
        score(1, found(0.9, 0.0, None)),
        score(3, found(0.5, 0.0, None)),
        score(3, found(0.5, 0.1, 0.4)),
        score(3, found(0.4, 0.3, 0.5)),
        score(3, found(0.4, 0.3, 0.4)),
        score(3, found(0.4, 0.35, 0.44)),  # five percent more balls outweigh four centimetres
    ]

    assert ranking == sorted(ranking)


@pytest.mark.parametrize(
    ("now", "alike"),
    [
        ({}, True),
        ({"rallies": 500}, False),
        ({"rounds": 5}, False),
        ({"task": {"launch": "strong"}}, False),
        ({"task": {"randomization": "hard"}}, False),
        ({"task": {"collision": "original"}}, False),
        ({"task": {"control_rate_hz": 100}}, False),
        ({"task": {"reward": {"landing_bonus": 0.0}}}, True),
        ({"task": {"observation": {"expected_spin": "strong"}}}, False),
        ({"experience": {"end_at_hit_share": 0.0}, "seed": 4, "interval_s": 5.0}, True),
    ],
)
def test_a_saved_policy_from_another_match_is_not_the_best(now, alike):
    """Otherwise a run that is resumed with another launch preset keeps the policy of the easier balls for ever."""
    kept = EvaluatorConfig()
    contract = contract_of(
        kept.task, kept.experience, kept.network, run="r", generation=1, version=1, stage=3, frames=1
    )
    # a failure of the simulation has ended one rally
    measures = {"rallies": kept.rallies - 1, "match": match_of(kept)}
    measured = contract.model_copy(update={"measures": measures})

    assert is_comparable(measured, EvaluatorConfig(**now)) == alike
