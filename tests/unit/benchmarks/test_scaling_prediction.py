"""The split that is found, what bounds it, and what the program prints."""

import json
from dataclasses import replace
from threading import Event

import pytest

from benchmarks.scaling.__main__ import ScalingConfig, main
from benchmarks.scaling.costs import Costs, Line, Network, read
from benchmarks.scaling.large_batches import FramesToGoal
from benchmarks.scaling.plan import Plan
from benchmarks.scaling.prediction import (
    LEARNING,
    PARTS,
    Setting,
    candidates,
    gains_of,
    predict,
    simulated,
    start_s,
    twice_as_fast,
)
from benchmarks.scaling.validation import rate
from common.errors import ReportedError
from tests.unit.benchmarks.test_scaling import COSTS

LAW = FramesToGoal(8e6, 60_000.0, 0.1, 4096, 131_072, 5, 0)
SETTING = Setting(COSTS, Network())


def with_costs(**changes):
    return replace(SETTING, costs=COSTS.model_copy(update=changes))


def test_two_cores_have_one_learner():
    found = predict(2, SETTING)

    assert found.plan.learners == 1
    assert found.plan.actors in (1, 2, 3)
    assert found.minutes is None


def test_more_cores_train_more_frames():
    rates = [predict(cores, SETTING).result.frames_per_s for cores in (1, 2, 4)]

    assert rates == sorted(rates)
    assert rates[-1] > 2 * rates[0]


PLAN = Plan(cores=8, actors=4, learners=2, envs=32, minibatch=1024)


@pytest.mark.parametrize(
    ("setting", "bound"),
    [
        (with_costs(play_s={4: 0.2, 256: 4.0}), "actors"),
        (with_costs(step=Line(per=1e-4)), "learner"),
        (with_costs(hub=Line(per=2e-7)), "hub and messages"),
        (with_costs(exchange=Line(each=5e-3)), "all-reduce"),
        (replace(SETTING, law=replace(LAW, noise=100.0)), LEARNING),
        (replace(with_costs(start_s=500.0), law=LAW), "start-up"),
    ],
)
def test_the_part_that_is_slow_gains_most(setting, bound):
    gains = gains_of(PLAN, simulated(PLAN, setting), setting)

    assert max(gains, key=gains.get) == bound
    assert 1.4 < gains[bound] <= 2.0001


def test_two_parts_that_share_a_core_gain_what_is_saved():
    """An actor and a learner on one core, 0.3 and 0.16384 s a dataset: half of either is saved."""
    plan = Plan(cores=1, actors=1)
    setting = Setting(Costs(machine="none", play_s={256: 0.3}, step=Line(per=5e-6)), Network())
    gains = gains_of(plan, simulated(plan, setting), setting)

    assert gains["actors"] == pytest.approx(0.46384 / 0.31384)
    assert gains["learner"] == pytest.approx(0.46384 / 0.38192)
    assert gains.keys() == {"actors", "learner", "hub and messages"}


def test_minutes_are_the_start_and_the_frames_that_such_datasets_need():
    found = predict(2, replace(with_costs(start_s=6.0), law=LAW))
    plan = found.plan
    needed = 8e6 * (1 + plan.dataset / 60_000)

    assert found.start_s == pytest.approx(6.0 * max(1.0, (plan.actors + plan.learners) / 2))
    assert found.minutes == pytest.approx((found.start_s + needed / found.result.frames_per_s) / 60)


@pytest.mark.parametrize(("largest", "extrapolated"), [(10_000, True), (10**7, False)])
def test_datasets_that_no_training_had_are_marked(largest, extrapolated):
    setting = replace(SETTING, law=replace(LAW, smallest=1, largest=largest, noise=1e9))

    assert predict(2, setting).is_extrapolated is extrapolated


def test_without_measured_trainings_actors_have_the_environments_that_the_program_gives_them():
    given = {1: 256, 2: 128, 3: 85, 12: 21, 24: 16, 60: 16}
    found = {plan.actors: plan.envs for cores in (2, 32, 61) for plan in candidates(cores, SETTING)}

    assert {actors: found[actors] for actors in given if actors in found} == {
        actors: envs for actors, envs in given.items() if actors in found
    }
    assert {1, 2, 3, 60} <= found.keys()


@pytest.mark.parametrize("law", [None, LAW])
def test_every_split_has_an_actor_for_each_learner_and_the_learners_own_minibatches(law):
    plans = list(candidates(32, replace(SETTING, law=law)))

    assert {plan.learners for plan in plans} == {1, 2, 3, 4, 6, 8, 12, 16}
    assert all(plan.actors >= plan.learners for plan in plans)
    # A quarter of a dataset, from 2,048 to 8,192 frames
    for plan in plans:
        size = min(max(plan.dataset // 4, 2048), 8192)
        assert abs(plan.steps - plan.dataset / size) <= 0.5 or plan.steps == 1
    assert all(plan.actors + plan.learners <= 32 for plan in plans)


def test_no_cores_are_refused():
    with pytest.raises(
        ReportedError, match=r"^0 cores are too few for an actor, a learner and what runs beside them$"
    ):
        predict(0, SETTING)


def test_every_cost_is_of_one_part():
    owned = [name for names in PARTS.values() for name in names]
    nobodys = {
        "machine",
        "rollout",
        "policy_bytes",
        "gradient_bytes",
        "generator_share",
        "evaluator_share",
        "slowdown",
    }

    assert len(owned) == len(set(owned))
    assert set(owned) | nobodys == set(Costs.model_fields)
    assert not set(owned) & nobodys


def test_a_part_that_is_twice_as_fast_costs_half_and_leaves_the_others():
    plan = next(iter(candidates(8, SETTING)))
    _, faster = twice_as_fast("actors", plan, SETTING)

    assert faster.costs.play_s == {4: 0.015, 256: 0.165}
    assert faster.costs.model_copy(update={"play_s": COSTS.play_s, "adopt_s": COSTS.adopt_s}) == COSTS
    assert twice_as_fast("all-reduce", plan, SETTING) == (plan, SETTING)  # one learner has none
    assert twice_as_fast(LEARNING, plan, SETTING) == (plan, SETTING)  # nothing is known of it


def test_processes_that_share_cores_start_later():
    plan = next(iter(candidates(2, SETTING)))

    assert (
        start_s(replace(plan, cores=2, actors=4, learners=2), COSTS.model_copy(update={"start_s": 3.0}))
        == 9.0
    )


# ---- the program


def printed(capsys, **settings):
    assert main(ScalingConfig(json_line=True, **settings), Event()) == 0
    said = capsys.readouterr()
    return json.loads(said.out.splitlines()[-1]), said.err


@pytest.fixture
def costs_file(tmp_path):
    file = tmp_path / "costs.json"
    file.write_text(COSTS.model_dump_json())
    return str(file)


def test_without_measured_trainings_there_are_rates_and_bounds_and_no_minutes(costs_file, tmp_path, capsys):
    points = str(tmp_path / "none.json")
    found, said = printed(capsys, costs=costs_file, cores=(1, 2), points=points)

    assert (found["machine"], found["learning"], found["validation"]) == ("none", None, [])
    assert [row["cores"] for row in found["predictions"]] == [1, 2]
    assert all(row["minutes"] is None and row["bound"] in PARTS for row in found["predictions"])
    assert f"no minutes, since {points} is not there" in said
    assert "2 cores: " in said


def test_with_measured_trainings_there_are_minutes(costs_file, tmp_path, capsys):
    points = [
        {
            "dataset": d,
            "minibatch": 2048,
            "frames": round(8e6 * (1 + d / 60_000)),
            "limit": 10**9,
            "seed": 0,
        }
        for d in (4096, 131_072)
    ]
    file = tmp_path / "points.json"
    file.write_text(json.dumps({"return_rate": 0.81, "target_error": 0.31, "points": points}))
    found, said = printed(capsys, costs=costs_file, cores=(2,), points=str(file), learner_frames_per_s=3e5)

    cores, accelerator = found["predictions"]
    assert found["goal"] == {"return_rate": 0.81, "target_error": 0.31}
    assert found["learning"]["dataset_noise"] == pytest.approx(60_000, rel=1e-3)
    assert 3 < cores["minutes"] < 10
    assert (accelerator["learner"], accelerator["learners"]) == ("accelerator", 1)
    assert accelerator["minutes"] < cores["minutes"]
    assert "minutes to the goal; bound by " in said


def test_a_file_of_costs_is_read_as_it_was_written(costs_file, tmp_path):
    assert read(tmp_path / "costs.json") == COSTS


@pytest.mark.parametrize(
    ("text", "fault"), [("{}", "machine: Field required"), ("x", "Invalid JSON"), (None, "No such file")]
)
def test_another_file_of_costs_is_refused_in_one_line(tmp_path, text, fault):
    file = tmp_path / "costs.json"
    if text is not None:
        file.write_text(text)

    with pytest.raises(ReportedError, match=f"^--costs {file}: {fault}[^\n]*$"):
        read(file)


# ---- validation


def test_a_runs_rate_counts_from_the_first_dataset_after_the_warm_up():
    rows = [
        {"seconds": str(2.0 * k), "frames": str(1000 * k * k), "lag": str(0.5 if k < 4 else 1.0)}
        for k in range(7)
    ]

    # from 5 s on: rows at 6, 8, 10 and 12 s with 9,000 to 36,000 frames
    assert rate(rows, 5.0) == pytest.approx((27_000 / 6.0, 1.0))


def test_a_run_with_one_dataset_after_the_warm_up_has_no_rate():
    with pytest.raises(
        ReportedError, match=r"^1 datasets after a warm-up of 5 s; allowed: two or more, with more"
    ):
        rate([{"seconds": "7.0", "frames": "8192", "lag": "1"}], 5.0)
