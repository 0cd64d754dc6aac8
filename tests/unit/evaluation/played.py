"""Made-up match results, for the tests of measures, breakdowns and report."""

import numpy as np

from common.evaluation.measures import MatchResult
from common.task.states import Outcome

NAN = float("nan")
RATES_AND_ERRORS = {
    "over_rate": 0.9,
    "over_rate_ci": [0.886, 0.912],
    "return_rate": 0.8175,
    "return_rate_ci": [0.8, 0.8338],
    "target_error_mean": 0.2812,
    "target_error_mean_ci": [0.2731, 0.2893],
    "target_error_median": 0.2488,
    "within_0.2_m": 0.38,
    "within_0.3_m": 0.611,
}
"""Some measures of a match, as JSON has them."""


def make_played(rows, **columns):
    """Return rallies from (outcome, caught, over, landing error); ``columns`` are other fields of MatchResult."""
    outcomes, caught, over, errors = zip(*rows, strict=True)
    n = len(rows)
    known = {
        "seeds": np.arange(n, dtype=np.uint64),
        "returns": np.zeros(n, np.float32),
        "rounds": np.ones(n, np.int32),
        "launches": np.tile([1.0, 0, 0.3, -5, 0, 0, 0, 0, 50, 1, 1, 0], (n, 1)),
        "landings": np.full((n, 2), NAN, np.float32),
        "targets": np.tile([0.7, 0.0], (n, 1)),
        "bounces": np.tile([-0.7, 0.0], (n, 1)),
        "arrivals": np.tile([-1.37, 0.0, 0.2], (n, 1)),
    }
    return MatchResult(
        outcomes=np.array(outcomes, np.uint8),
        landing_errors=np.array(errors, np.float32),
        caught=np.array(caught),
        over=np.array(over),
        **known | {name: np.asarray(values) for name, values in columns.items()},
    )


RETURNED = (Outcome.RETURNED, True, True, 0.2)
OUT = (Outcome.OUT, True, True, NAN)
MISSED = (Outcome.MISS, False, False, NAN)


def random_played(n, seed=0):
    """Return rallies of all kinds: launches, outcomes and places at random."""
    rng = np.random.default_rng(seed)
    rows = [(RETURNED, OUT, MISSED)[k] for k in rng.integers(3, size=n)]
    launches = rng.uniform(-1, 1, (n, 12)) * [1, 1, 1, 1, 4, 1, 200, 200, 200, 1, 1, 0]
    launches[:, 11] = rng.integers(6, size=n)
    launches[:, 3] = rng.uniform(-9, -3, n)
    arrivals = rng.uniform([-1.37, -1.2, -0.2], [-1.37, 1.2, 0.6], (n, 3))
    arrivals[rng.random(n) < 0.1] = NAN
    targets = rng.uniform([0.1, -0.74], [1.35, 0.74], (n, 2))
    landed = np.array([row is RETURNED for row in rows])
    landings = np.where(landed[:, None], targets + rng.normal(0, 0.2, (n, 2)), NAN)
    played = make_played(
        rows,
        seeds=np.arange(n, dtype=np.uint64),
        launches=launches,
        arrivals=arrivals,
        targets=targets,
        landings=landings.astype(np.float32),
        bounces=rng.uniform([-1.37, -0.76], [0, 0.76], (n, 2)),
    )
    errors = np.linalg.norm(landings - targets, axis=1).astype(np.float32)
    return make_played_with(played, landing_errors=errors)


def make_played_with(played, **columns):
    """Return the same rallies with other columns."""
    fields = {name: getattr(played, name) for name in played.__dataclass_fields__}
    return MatchResult(**fields | columns)
