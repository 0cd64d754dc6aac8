"""The best policy of a run, as functions of values."""

from typing import Any

from common.policy.contract import Contract
from services.evaluator.config import EvaluatorConfig


def score(stage: int, found: dict[str, Any]) -> tuple[int, float]:
    """Return the score that decides the best policy: the stage first, then the stage's measure.

    Stages 1 and 2: the catch rate. Stage 3: the return rate minus the landing error, one centimetre for one percent. By
    the return rate alone a policy that aims at the middle of the table would be the best.
    """
    if stage < 3:
        return stage, found["catch_rate"] or 0.0
    error = found["target_error_mean"]
    return stage, (found["return_rate"] or 0.0) - (error if error is not None else 1.0)


def match_of(config: EvaluatorConfig) -> dict[str, Any]:
    """Return the match's conditions in the form of a saved policy's measures."""
    return {"rallies": config.rallies, "rounds": config.rounds}


def is_comparable(contract: Contract, config: EvaluatorConfig) -> bool:
    """Return whether a saved policy was measured in the match of ``config``; the reward does not matter."""
    ignored = {"reward"}
    return contract.measures.get("match") == match_of(config) and (
        contract.task.model_dump(exclude=ignored) == config.task.model_dump(exclude=ignored)
    )
