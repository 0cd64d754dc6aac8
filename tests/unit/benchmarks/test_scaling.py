"""A run in virtual time agrees with what a few lines of arithmetic say of simple runs."""

from collections import Counter

import numpy as np
import pytest
import torch

from benchmarks.scaling.costs import Costs, Line, Network, exchange_line, gather_s, sum_s
from benchmarks.scaling.plan import Plan, available_cores
from benchmarks.scaling.simulate import (
    RECOUNT_S,
    REPORT_INTERVAL_S,
    SMALL_EXCHANGES,
    TURN_WAIT_S,
    simulate,
)
from common.errors import ReportedError
from services.actor import delivery
from services.learner import lockstep
from services.learner import service as learner_service
from services.learner.group import Group
from services.learner.ppo import minibatches, whole
from tests.unit.services.learner.rollouts import make_rollout
from tests.unit.services.learner.test_ppo import make_data
from tests.unit.services.learner.test_training import PPO, make_training

FULL = Line(each=2e-3, per=5e-6)
# About what a core does, all parts
COSTS = Costs(
    machine="none",
    play_s={4: 0.03, 256: 0.33},
    adopt_s=2e-3,
    send=Line(each=2e-4, per=5e-10),
    opening=Line(each=2e-4, per=2e-7),
    reading=Line(each=1e-3, per=3e-6),
    step=FULL,
    whole_frame_s=1e-7,
    publish_s=1e-3,
    hub=Line(each=2e-4, per=5e-10),
    hub_policy_byte_s=5e-10,
    latency_s=3e-4,
    exchange=Line(each=1e-4, per=6e-10),
    rollout=Line(each=600, per=359),
    policy_bytes=492_000,
    gradient_bytes=490_000,
    generator_share=0.015,
    evaluator_share=0.06,
    slowdown=1.1,
)


def costs(**changes):
    """Return costs of an actor's rollout and of gradient steps, and none of anything else."""
    return Costs(**({"machine": "none", "play_s": {256: 0.3}, "step": Line(per=5e-6)} | changes))


def rate(plan, found, network=None):
    return simulate(plan, found, network).frames_per_s


# 8,192 frames of 4 passes at 5 us are 0.16384 s; at 20 us 0.65536 s. A rollout of 8,192 frames takes 0.3 s.


@pytest.mark.parametrize(("step_s", "expected"), [(5e-6, 8192 / 0.3), (20e-6, 8192 / 0.65536)])
def test_an_actor_and_a_learner_with_a_core_each_go_as_fast_as_the_slower(step_s, expected):
    found = rate(Plan(cores=2, actors=1), costs(step=Line(per=step_s)))

    assert found == pytest.approx(expected, rel=1e-6)


def test_the_cores_that_are_used_are_the_work_in_a_second():
    result = simulate(Plan(cores=4, actors=1), costs())

    assert result.cores_used == pytest.approx((0.3 + 0.16384) / 0.3)
    assert (result.actor_busy, result.learner_busy) == pytest.approx((1.0, 0.16384 / 0.3))


def test_on_one_core_the_costs_add_up():
    assert rate(Plan(cores=1, actors=1), costs()) == pytest.approx(8192 / (0.3 + 0.16384), rel=1e-6)


def test_beside_an_evaluator_of_half_a_core_one_core_does_half():
    found = costs(evaluator_share=0.5)

    assert rate(Plan(cores=1, actors=1), found) == pytest.approx(8192 / 2 / (0.3 + 0.16384), rel=1e-6)
    assert rate(Plan(cores=1, actors=1, evaluates=False), found) == pytest.approx(8192 / 0.46384, rel=1e-6)


def test_with_many_actors_the_learners_rate_counts():
    result = simulate(Plan(cores=64, actors=32, envs=16), costs(play_s={16: 0.02}))

    assert result.frames_per_s == pytest.approx(16384 / (4 * 16384 * 5e-6), rel=1e-6)
    assert result.learner_busy == pytest.approx(1.0)


def test_a_learners_dataset_takes_what_its_parts_take():
    """Two actors: open 2 rollouts, read 2, 16 gradient steps of 1,024 frames, whatever each of 4,096 frames costs."""
    found = costs(
        play_s={64: 1e-3},
        opening=Line(each=0.01, per=1e-6),
        reading=Line(each=0.02, per=2e-6),
        step=Line(each=0.003, per=5e-6),
        whole_frame_s=1e-6,
        publish_s=0.004,
    )
    dataset_s = 2 * (0.01 + 2.048e-3) + 2 * (0.02 + 4.096e-3) + 16 * (0.003 + 5.12e-3) + 4.096e-3 + 0.004

    assert rate(Plan(cores=8, actors=2, envs=64, minibatch=1024), found) == pytest.approx(
        4096 / dataset_s, rel=1e-6
    )


def test_two_ranks_halve_the_update_and_add_the_exchanges():
    """16 steps of 2,048 frames each with a sum; five small messages and one of 8 bytes a frame; and the turn's."""
    found = costs(play_s={256: 0.01}, exchange=Line(each=1e-3, per=1e-9), gradient_bytes=400_000)
    steps_s = 16 * (2048 * 5e-6 + 2 * (1e-3 + 200_000e-9))
    others_s = (1 + 4) * 1e-3 + (1e-3 + 16384 * 8 / 2 * 1e-9) + (1e-3 + 72e-9)
    result = simulate(Plan(cores=64, actors=2, learners=2, minibatch=4096), found)

    assert result.frames_per_s == pytest.approx(16384 / (steps_s + others_s), rel=1e-4)
    assert result.exchange == pytest.approx(1 - 16 * 2048 * 5e-6 / (steps_s + others_s), rel=1e-3)


def test_a_learner_on_an_accelerator_trains_its_own_rate_and_opens_rollouts_on_a_core():
    plan = Plan(cores=64, actors=32, envs=16, learner_frames_per_s=1e6)
    found = costs(play_s={16: 1e-3}, opening=Line(each=1e-3), reading=Line(each=1.0))

    assert rate(plan, found) == pytest.approx(16384 / (16384e-6 + 32e-3), rel=1e-6)


def test_a_hub_that_takes_50_ms_for_a_rollout_lets_20_through_in_a_second():
    found = costs(play_s={16: 1e-3}, step=Line(), hub=Line(per=1e-6), rollout=Line(per=100.0))

    assert rate(Plan(cores=64, actors=8, envs=16), found) == pytest.approx(512 / 0.0512, rel=1e-2)


def test_half_of_the_bytes_cross_the_link_of_a_fleet_of_two_hosts():
    found = costs(play_s={16: 1e-3}, rollout=Line(per=100.0))
    network = Network(host_cores=32, bytes_per_s=1e6, latency_s=0.0)

    assert rate(Plan(cores=64, actors=8, envs=16), found, network) == pytest.approx(2 * 1e6 / 100, rel=1e-2)
    assert rate(Plan(cores=32, actors=8, envs=16), found, network) > 45_000  # one host


def test_all_busy_cores_slow_each_other_down():
    """The learner works half of the time: then both cores are busy, and both work 1.5 times as long."""
    found = costs(step=Line(per=0.15 / 4 / 8192), slowdown=1.5)
    # together for 0.15 of work at 1 / 1.5, then the actor alone for what is left of its 0.3
    expected = 0.15 * 1.5 + 0.15

    assert rate(Plan(cores=2, actors=1), found) == pytest.approx(8192 / expected, rel=1e-6)


@pytest.mark.parametrize(
    ("actors", "learners", "cores"), [(1, 1, 2), (3, 1, 2), (2, 2, 2), (5, 3, 8), (24, 1, 32), (16, 8, 24)]
)
def test_the_pacing_keeps_a_lag_of_one_and_refuses_nothing(actors, learners, cores):
    envs = max(16, 256 // actors)
    result = simulate(Plan(cores=cores, actors=actors, learners=learners, envs=envs), COSTS)

    assert 0.7 < result.lag <= 1.0
    assert result.refused == 0


def test_a_run_is_the_same_each_time():
    plan = Plan(cores=8, actors=5, learners=3, envs=51)

    assert simulate(plan, COSTS) == simulate(plan, COSTS)


@pytest.mark.parametrize("cores", [1, 2, 4, 8])
def test_no_run_does_more_work_than_its_cores(cores):
    plan = Plan(cores=cores, actors=4, envs=64)
    found = rate(plan, COSTS)
    work_s = 4 * COSTS.playing(64) + 16 * COSTS.step.of(2048) + 4 * COSTS.reading.of(2048)

    assert found * work_s / 8192 < available_cores(plan, COSTS)


def test_background_load_that_leaves_no_core_is_refused():
    with pytest.raises(
        ReportedError, match=r"^1 cores for 80 actors: generators and evaluator need 1.26 of them$"
    ):
        simulate(Plan(cores=1, actors=80), COSTS)


# ---- what is said of the program


def test_the_pauses_are_those_of_the_services():
    assert REPORT_INTERVAL_S == delivery.REPORT_INTERVAL_S
    assert TURN_WAIT_S == learner_service.TURN_WAIT_S
    assert RECOUNT_S == lockstep.RECOUNT_S


@pytest.mark.parametrize("minibatch", [64, 100, 120, 200, 256, 300, 600])
def test_a_pass_has_as_many_gradient_steps_as_the_program_makes(minibatch):
    torch.manual_seed(0)
    data = make_data(make_training().network, count=256)
    made = list(minibatches(data, minibatch, torch.Generator(), whole(data)))

    assert Plan(cores=1, actors=1, envs=8, minibatch=minibatch).steps == len(made)


class Counting(Group):
    """A group that counts its exchanges."""

    def add(self, values):
        self.seen["add", values.size > 10] += 1

    def gathered(self, *arrays, on_tick=None):
        self.seen["gathered", any(len(array) > 100 for array in arrays)] += 1
        return [list(arrays)] * self.size

    def gathered_bytes(self, items, on_tick=None):
        self.seen["gathered", False] += 1
        return [list(items)] * self.size


Counting.seen = Counter()


def test_an_epoch_has_the_exchanges_that_are_counted():
    training = make_training()
    training.group = Counting(0, 2)
    training.run_epoch([make_rollout()])
    training.group.of_leader(b"")  # whether it saves
    seen, passes = Counting.seen, PPO.mini_epochs
    small = seen["gathered", False] + seen["add", False]  # sums of gradients count apart

    assert seen["gathered", True] == 1  # the values of all frames
    assert small == SMALL_EXCHANGES + passes
    assert seen["add", True] == passes * Plan(cores=1, actors=2, envs=4, minibatch=64, passes=2).steps


# ---- costs


def test_a_sum_over_four_ranks_is_six_steps_of_a_ring_with_a_quarter_each():
    found = costs(exchange=Line(each=1e-3, per=1e-6))

    assert sum_s(found, Network(), 4, 4000.0) == pytest.approx(6 * (1e-3 + 1e-3))
    assert gather_s(found, Network(), 4, 4000.0) == pytest.approx(3 * (1e-3 + 1e-3))
    assert sum_s(found, Network(), 1, 4000.0) == 0.0


def test_ranks_that_do_not_fit_on_a_host_have_the_network_between_them():
    found = costs(exchange=Line(each=1e-3, per=1e-9))
    network = Network(host_cores=2, bytes_per_s=1e6, latency_s=0.01)

    assert sum_s(found, network, 4, 4000.0) == pytest.approx(6 * (0.01 + 1e-3 + 1e-3))


def test_the_ring_that_is_fitted_to_two_sums_gives_these_sums():
    found = costs(exchange=exchange_line([(8.0, 2e-4), (400_000.0, 9e-4)]))

    assert sum_s(found, Network(), 2, 8.0) == pytest.approx(2e-4)
    assert sum_s(found, Network(), 2, 400_000.0) == pytest.approx(9e-4)


def test_playing_is_interpolated_between_measured_sizes():
    found = costs(play_s={4: 0.03, 16: 0.05, 256: 0.33})

    assert [found.playing(envs) for envs in (2, 4, 10, 256, 512)] == pytest.approx(
        [0.03, 0.03, 0.04, 0.33, 0.66]
    )


def test_a_line_goes_through_two_points_and_not_below_zero():
    line = Line.through((100, 0.2), (1100, 1.2))

    assert (line.of(100), line.of(1100)) == pytest.approx((0.2, 1.2))
    assert Line.through((100, 0.1), (1100, 1.2)).each == 0.0
    assert Line.through((100, 0.3), (1100, 0.2)).per == 0.0
    np.testing.assert_allclose(line.times(0.5).of(600), 0.35)
