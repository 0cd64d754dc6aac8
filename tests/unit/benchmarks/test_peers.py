import time

import numpy as np
import psutil
import pytest
import torch
from torch import nn

from benchmarks.peers import task
from benchmarks.peers.__main__ import over_best, summary
from benchmarks.peers.measuring import (
    CpuMeter,
    SavedPolicy,
    catch_rate,
    figures_of,
    fresh_balls,
    seconds_to_goal,
)
from benchmarks.peers.single_file import advantages
from benchmarks.peers.trainers import OURS, TRAINERS, find_trainers
from common.errors import ReportedError
from services.learner.advantage import gae


def make_order(folder, *, ago: float = 0.0, seconds: float = 1e9) -> task.Order:
    return task.Order(folder, started=time.time() - ago, seconds=seconds, seed=0, threads=1)


def make_policy() -> task.Normalized:
    torch.manual_seed(0)
    return task.Normalized(
        torch.randn(task.OBS),
        torch.rand(task.OBS) + 0.5,
        2.0,
        nn.Sequential(task.make_trunk(), nn.Linear(32, 7)),
    )


def write_progress(folder, rows) -> CpuMeter:
    (folder / task.PROGRESS).write_text("".join(f"{seconds},{frames}\n" for seconds, frames in rows))
    meter = CpuMeter(psutil.Process().pid)
    meter.samples = [(0.0, 1.0), (100.0, 51.0)]  # half a core
    return meter


def make_row(**changes) -> dict:
    row = {"frames_per_s": 1.0, "frames_per_cpu_s": 1.0, "cores": 1.0, "frames": 1, "catch_rate": 0.5}
    return row | {"seconds_to_catch_080": None} | changes


def test_a_saved_policy_acts_as_the_one_that_was_saved(tmp_path):
    policy, obs = make_policy(), 3.0 * torch.randn(5, task.OBS)
    recorder = task.Recorder(make_order(tmp_path, ago=20.0))
    is_over = recorder.note(8192, lambda: policy)
    (file,) = tmp_path.glob("*.pt")

    assert not is_over
    assert file.name.endswith("-8192.pt")
    np.testing.assert_allclose(SavedPolicy(file).act(obs.numpy()), policy(obs).detach(), atol=1e-6)


def test_policies_are_kept_now_and_then_and_at_the_end(tmp_path):
    recorder = task.Recorder(make_order(tmp_path, ago=task.SNAPSHOT_S + 1.0))
    for frames in (1, 2, 3):
        assert not recorder.note(frames, make_policy)
    assert len(list(tmp_path.glob("*.pt"))) == 1

    waits = task.Recorder(make_order(tmp_path, ago=task.SNAPSHOT_S + 1.0))
    for frames, policy in (
        (10, None),
        (11, make_policy()),
        (12, make_policy()),
    ):  # its learner saves by itself
        waits.note(frames, lambda policy=policy: policy)
    assert len(list(tmp_path.glob("*-11.pt"))) == 1
    assert len(list(tmp_path.glob("*-1[02].pt"))) == 0

    late = task.Recorder(make_order(tmp_path, ago=5.0, seconds=4.0))
    assert late.note(4, make_policy)
    assert len(list(tmp_path.glob("*-4.pt"))) == 1


def test_an_untrained_policy_catches_few_balls_and_never_reaches_the_goal(tmp_path):
    file = tmp_path / "1.0-1.pt"
    task.save(make_policy(), file)
    balls = fresh_balls(40)

    assert catch_rate(file, balls, lambda: None) < 0.5
    assert seconds_to_goal([(1.0, file)], balls, lambda: None) is None


def test_rates_begin_when_a_trainer_has_settled(tmp_path):
    rows = [(20.0, 1000), (22.0, 9999), (26.0, 10_000), (36.0, 20_000)]
    meter = write_progress(tmp_path, rows)
    found = figures_of(TRAINERS[1], tmp_path, tmp_path / "log.txt", meter)

    assert (found.frames_per_s, found.frames_per_cpu_s, found.cores, found.frames) == (
        pytest.approx(1000.0),
        pytest.approx(2000.0),
        pytest.approx(0.5),
        20_000,
    )


def test_a_trainer_without_updates_is_an_error_with_the_end_of_its_log(tmp_path):
    meter = write_progress(tmp_path, [(20.0, 1000)])
    log = tmp_path / "log.txt"
    log.write_text("starting\n\x1b[31mno such optimizer\x1b[0m\n")

    with pytest.raises(ReportedError, match=r"sb3: 1 updates; it said last: no such optimizer$"):
        figures_of(TRAINERS[2], tmp_path, log, meter)


def test_the_cpu_time_of_ended_processes_still_counts():
    meter = CpuMeter(psutil.Process().pid)
    meter._used[-1] = 1000.0
    meter.look(3.0)

    assert meter.at(3.0) > 1000.0


def test_medians_count_a_training_without_the_goal_as_the_slowest():
    rows = [
        make_row(seconds_to_catch_080=40.0),
        make_row(),
        make_row(seconds_to_catch_080=60.0, frames_per_s=3.0),
    ]
    found = summary(rows)

    assert (found["seconds_to_catch_080"], found["reached_080"]) == (60.0, 2)
    assert (found["frames_per_s"], found["frames_per_s_range"]) == (1.0, [1.0, 3.0])
    assert summary(rows[1:2])["seconds_to_catch_080"] is None


def test_ours_is_compared_with_the_best_of_the_others():
    assert over_best({"x": 6.0}, [{"x": 2.0}, {"x": 3.0}], "x") == 2.0
    assert over_best({"x": 6.0}, [], "x") is None
    assert over_best(None, [{"x": 2.0}], "x") is None


def test_peers_are_chosen_by_name_and_ours_always_runs():
    assert [trainer.name for trainer in find_trainers(("rllib",))] == [OURS, "rllib"]
    with pytest.raises(ReportedError, match="peers sb2; allowed: single_file, sb3"):
        find_trainers(("sb2",))


def test_the_single_files_advantages_are_the_learners():
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=(2, 6, 3)).astype(np.float32)
    last, final = rng.normal(size=3).astype(np.float32), rng.normal(size=(6, 3)).astype(np.float32)
    terminated, truncated = np.zeros((2, 6, 3), bool)
    terminated[1, 0] = terminated[4, 2] = truncated[3, 1] = truncated[5, 0] = True
    got = advantages(
        torch.from_numpy(rewards),
        torch.from_numpy(np.concatenate([values, last[None]])),
        torch.from_numpy(terminated | truncated).float(),
        torch.from_numpy(np.where(truncated, final, 0.0)),
    )
    wanted = gae(rewards, values, terminated, truncated, final, last, task.GAMMA, task.GAE_LAMBDA)

    np.testing.assert_allclose(got.numpy(), wanted, atol=1e-5)
