"""Runs, policies and results for the tests of reports."""

from common.evaluation.measures import measures
from common.policy.config import NetworkConfig
from common.policy.contract import contract_of
from common.policy.folder import Policy
from common.policy.normalizer import Moments
from common.policy.weights import new_network
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.observation import critic_layout, size
from tests.unit.evaluation.played import make_played
from topspin.report.collect import Run
from topspin.report.results import RunResult


def make_run(name="r", missing=(), **settings):
    return Run(name, {"seed": 0} | settings, None, None, None, tuple(missing))


def make_policy(observation):
    """Return a fresh policy of a task with these observation options."""
    network, task = NetworkConfig(units=(8,)), TaskConfig(observation=observation)
    contract = contract_of(
        task, ExperienceConfig(), network, run="r", generation=1, version=3, stage=2, frames=3000
    )
    return Policy(
        new_network(network, observation), Moments.initial(size(critic_layout(observation))), contract
    )


def make_result(run, rows, seed=0):
    played = make_played(rows)
    return RunResult(run, seed, "", None, None, played, None, measures(played), {})
