import copy
import csv
import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from common.comms.messages import Episodes
from common.policy.config import NetworkConfig
from common.policy.normalizer import Moments, normalize
from common.task.experience import TeacherConfig
from services.learner.checkpoint import CheckpointError, Extras, checkpoints, restore, save
from services.learner.config import CurriculumConfig, PPOConfig
from services.learner.curriculum import StageLengths
from services.learner.epoch_stats import merged, play_counts
from services.learner.ppo import UpdateMode
from services.learner.run_log import RunLog, row
from services.learner.training import Training
from tests.unit.services.learner.rollouts import ROLLOUT_FRAMES, make_rollout

PPO = PPOConfig(minibatch=64, mini_epochs=2, refit_frames=1)
DATASET = 2 * ROLLOUT_FRAMES
CURRICULUM = CurriculumConfig(stage_1=3 * DATASET, stage_2=2 * DATASET, stage_3=50 * DATASET)
EXTRAS = Extras(run="r", generation=7, stage_log=[], accounts=[], trained_seconds=1.5)


def make_training(seed=0, ppo=PPO, curriculum=CURRICULUM, frames=0):
    return Training(
        ppo, NetworkConfig(units=(16, 8)), StageLengths(curriculum, frames), np.zeros(7, np.float32), seed
    )


def dataset(epoch):
    return [make_rollout(10 * epoch), make_rollout(10 * epoch + 1)]


def state(training):
    return [value.clone() for value in training.network.state_dict().values()]


def assert_same(one, other):
    assert one.progress == other.progress
    for a, b in zip(state(one), state(other), strict=True):
        assert torch.equal(a, b)
    for which in ("obs_moments", "value_moments"):
        a, b = getattr(one, which), getattr(other, which)
        np.testing.assert_array_equal(a.mean, b.mean)
        np.testing.assert_array_equal(a.var, b.var)
        assert a.count == b.count


def test_the_same_data_train_the_same_policy_bit_for_bit():
    one, other = make_training(), make_training()
    for epoch in range(4):
        one.run_epoch(dataset(epoch))
        other.run_epoch(dataset(epoch))

    assert_same(one, other)
    assert one.progress.frames == 4 * 2 * 16 * 8


def test_an_update_uses_the_normaliser_of_its_actors():
    training = make_training(ppo=PPO.model_copy(update={"precision": "float32"}))
    rollouts = dataset(0)
    frozen = training.obs_moments

    data = training.read(rollouts).data
    training.run_epoch(rollouts)

    np.testing.assert_array_equal(frozen.mean, 0.0)  # at the start only the clip has an effect
    expected = np.clip(rollouts[0].obs.reshape(-1, 37), -5, 5)
    np.testing.assert_allclose(data.obs[: len(expected)].numpy(), expected, rtol=1e-4)
    every = np.concatenate([r.obs.reshape(-1, 37) for r in rollouts]).astype(np.float64)
    merged = Moments.initial(37).merged(Moments.of(every))
    np.testing.assert_allclose(training.obs_moments.mean, merged.mean, atol=1e-12)
    np.testing.assert_allclose(training.obs_moments.var, merged.var, rtol=1e-12)


def test_a_stage_change_carries_weights_over_and_resets_the_observation_count_alone():
    training = make_training()
    for epoch in range(2):
        training.run_epoch(dataset(epoch))
    assert training.datasets_left == 1
    weights, values = state(training), training.value_moments.count

    stats = training.run_epoch(dataset(2))

    assert stats.stage_changed
    assert (training.progress.stage, training.progress.stage_number, training.progress.epochs_in_stage) == (
        2,
        1,
        0,
    )
    assert training.obs_moments.count == 1
    assert training.value_moments.count > values
    assert any(not torch.equal(a, b) for a, b in zip(weights, state(training), strict=True))


@pytest.mark.parametrize(("count_reset", "plays_on"), [("absorbed", True), ("raw", False)])
def test_the_reset_of_the_count_is_absorbed_by_the_network_or_raw(count_reset, plays_on):
    training = make_training(curriculum=CURRICULUM.model_copy(update={"count_reset": count_reset}))
    for epoch in range(3):
        training.run_epoch(dataset(epoch))
    far = [make_rollout(40)]
    far[0].obs[...] = 3.0 * far[0].obs + 2.0  # the moments jump to those of the next dataset
    raw, before = make_rollout(77).obs.reshape(-1, 37), training.obs_moments
    critic_only = training.read(far)
    assert before.count == 1
    network = copy.deepcopy(training.network)
    training.run_epoch(far)  # refit: the policy's weights do not learn in it
    played = [
        n(torch.from_numpy(normalize(0.1 * raw, m)))[0].detach()
        for n, m in ((network, before), (training.network, training.obs_moments))
    ]

    assert critic_only.frames == training.obs_moments.count - 1
    assert training.obs_moments.mean.mean() > 1.5
    assert torch.allclose(*played, atol=1e-3) == plays_on


def test_the_schedule_is_constant_and_then_linear_over_the_last_stage():
    ppo = PPO.model_copy(update={"schedule": "constant_then_linear", "refit_frames": 0, "target_kl": 1e-6})
    curriculum = CurriculumConfig(stage_shares=(0.25, 0.25, 0.5))
    size = 2 * 16 * 8
    training = make_training(ppo=ppo, curriculum=curriculum, frames=8 * size)
    stats = [training.run_epoch(dataset(epoch)) for epoch in range(8)]
    rates = [one.update.learning_rate for one in stats]

    assert [one.progress.stage for one in stats] == [1, 2, 2, 3, 3, 3, 3, 3]
    assert all(one.update.kl > 2e-6 for one in stats)  # "adaptive" would have divided the rate
    assert rates[:5] == [5e-4] * 5
    assert rates[5:] == pytest.approx([5e-4 - k / 4 * (5e-4 - 2e-5) for k in (1, 2, 3)])


def test_the_evaluated_weights_are_the_mean_or_the_newest():
    training = make_training()
    training.run_epoch(dataset(0))

    assert training.weights("mean") is training.average
    assert training.weights("newest") is training.network


def test_the_mean_of_young_weights_covers_few_datasets():
    """A mean over 100 datasets from the start on was half as good as the newest weights after 350."""
    training = make_training(curriculum=CURRICULUM.model_copy(update={"stage_1": 100 * DATASET}))
    expected = training.average.mean.weight.detach().double().clone()
    for epoch in range(30):
        training.run_epoch(dataset(epoch % 3))
        expected += (training.network.mean.weight.detach() - expected) / (1.0 + ((epoch + 1) / 120.0) ** 2)

    torch.testing.assert_close(training.average.mean.weight.double(), expected, rtol=1e-4, atol=1e-6)


def test_the_mean_of_old_weights_covers_100_datasets():
    training = make_training(curriculum=CURRICULUM.model_copy(update={"stage_1": 100 * DATASET}))
    training.progress = replace(training.progress, version=100_000)
    before = training.average.mean.weight.detach().clone()
    training.run_epoch(dataset(0))
    moved = training.average.mean.weight - before

    torch.testing.assert_close(moved, (training.network.mean.weight - before) / 100.0, rtol=1e-3, atol=1e-9)


def test_a_gate_that_opens_near_the_stages_end_promises_no_more_datasets_than_it_has():
    """Actors collect what is promised, and a dataset of the stage before would be lost."""
    curriculum = CURRICULUM.model_copy(update={"catch_gate": 1e-6})
    training = Training(
        PPO, NetworkConfig(units=(16, 8)), StageLengths(curriculum), np.zeros(7, np.float32), 0, notice=4
    )
    promised = []
    for epoch in range(3):
        training.run_epoch(dataset(epoch))
        promised.append((training.progress.stage, training.datasets_left))

    assert promised == [(1, 2), (1, 1), (2, 2)]


def test_the_first_epochs_of_a_new_stage_train_the_critic_only():
    raw = 0.3 * make_rollout(77).obs.reshape(-1, 37)

    def outputs(training):
        with torch.no_grad():
            return training.network(torch.from_numpy(normalize(raw, training.obs_moments)))

    curriculum = CURRICULUM.model_copy(update={"stage_2": 50 * DATASET})

    def moved(refit_frames):
        ppo = PPO.model_copy(
            update={"refit_frames": refit_frames, "learning_rate_min": 3e-3, "learning_rate_max": 3e-3}
        )
        training = Training(
            ppo, NetworkConfig(units=(16, 8)), StageLengths(curriculum), np.zeros(7, np.float32), 0
        )
        for epoch in range(3):
            training.run_epoch(dataset(epoch))
        before, value_before = outputs(training)
        telling = [replace(r, rewards=10 * r.actions[..., 0]) for r in dataset(3)]
        for _ in range(4):
            training.run_epoch(telling)
        after, value_after = outputs(training)
        return float((after - before).square().mean()), float((value_after - value_before).square().mean())

    held, held_value = moved(refit_frames=4 * DATASET)
    free, free_value = moved(refit_frames=0)

    assert held < 1e-9  # rounding, as the normaliser changes
    assert free > 1e-5
    assert held_value > 1e-4
    assert free_value > 1e-4


def test_a_resumed_run_continues_bit_for_bit(tmp_path):
    straight, before, after = make_training(), make_training(), make_training(seed=99)
    for epoch in range(4):
        straight.run_epoch(dataset(epoch))
        before.run_epoch(dataset(epoch))
    path = save(tmp_path, before, EXTRAS)
    extras = restore(path, after)
    for epoch in range(4, 8):
        straight.run_epoch(dataset(epoch))
        after.run_epoch(dataset(epoch))

    assert extras == EXTRAS
    assert_same(straight, after)


def test_only_the_newest_checkpoints_are_kept(tmp_path):
    training = make_training()
    for epoch in range(5):
        training.run_epoch(dataset(epoch))
        save(tmp_path, training, EXTRAS)

    assert [path.stem for path in checkpoints(tmp_path)] == ["00000003", "00000004", "00000005"]
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "can't read checkpoint .*: No such file"),
        (lambda path: path.write_bytes(b"rubbish"), "not readable"),
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "not readable"),
        (lambda path: reword(path, '"format": 3', '"format": 9'), "has format 9; allowed is 3"),
    ],
)
def test_an_unusable_checkpoint_is_refused_with_one_line(tmp_path, damage, message):
    training = make_training()
    training.run_epoch(dataset(0))
    path = save(tmp_path, training, EXTRAS)
    damage(path)

    with pytest.raises(CheckpointError, match=message) as caught:
        restore(path, make_training())

    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_another_network_is_refused_with_the_parameter_that_differs(tmp_path):
    path = save(tmp_path, make_training(), EXTRAS)
    other = Training(PPO, NetworkConfig(units=(16, 9)), StageLengths(CURRICULUM), np.zeros(7, np.float32), 0)

    with pytest.raises(CheckpointError, match=r"doesn't fit this configuration: weights '.*' have shape"):
        restore(path, other)


def reword(path, old, new):
    """Change the header's text; it must keep its length."""
    content = path.read_bytes()
    old_bytes, new_bytes = json.dumps(old)[1:-1].encode(), json.dumps(new)[1:-1].encode()
    assert content.count(old_bytes) == 1
    path.write_bytes(content.replace(old_bytes, new_bytes))


def test_unvalidated_balls_are_in_no_rate():
    stats = merged(play_counts([make_rollout(0), make_rollout(1)])[None])

    assert (stats.rallies, stats.unvalidated) == (8, 2)
    assert (stats.caught, stats.over, stats.returned) == (4, 2, 2)
    assert stats.error_sum == pytest.approx(0.4)
    assert (stats.catch_rate, stats.over_rate, stats.return_rate) == (0.5, 0.25, 0.25)
    assert stats.target_error == pytest.approx(0.2)
    assert stats.outcomes.sum() == 8
    np.testing.assert_allclose(stats.reward_terms, 2 * np.arange(8) / (2 * 16 * 8))


def test_an_epoch_without_ended_rallies_has_nan_rates_in_the_log(tmp_path):
    """No rally ended, or no validated one."""
    training, record = make_training(), RunLog(tmp_path / "metrics.csv", tmp_path / "tb", tmp_path / "e.csv")
    ended = make_rollout(0).episodes
    for epoch, episodes in enumerate(
        (
            ended,
            replace(ended, unvalidated=np.ones(5, bool)),
            Episodes(**{field.name: getattr(ended, field.name)[:0] for field in fields(ended)}),
        )
    ):
        record.append(row(training.run_epoch([make_rollout(epoch, episodes=episodes)]), 1.0, 100.0))
    record.close()

    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [line["rallies"] for line in rows] == ["4", "0", "0"]
    for name in ("catch_rate", "over_rate", "return_rate", "target_error", "episode_return"):
        values = [float(line[name]) for line in rows]
        np.testing.assert_array_equal(np.isnan(values), [False, True, True], err_msg=name)


def test_a_new_normaliser_does_not_change_what_a_later_stage_plays():
    """The count's reset lets the moments jump; without compensation this alone destroys the old policy."""
    training = make_training()
    for epoch in range(3):
        training.run_epoch(dataset(epoch))
    assert training.progress.stage == 2
    raw = 0.3 * make_rollout(77).obs.reshape(-1, 37)  # away from the clip
    with torch.no_grad():
        before = training.network(torch.from_numpy(normalize(raw, training.obs_moments)))[0]
    moments = training.obs_moments
    training.run_epoch(
        [replace(r, obs=1.0 + 0.7 * r.obs) for r in dataset(3)]
    )  # refitting: only the critic learns
    with torch.no_grad():
        after = training.network(torch.from_numpy(normalize(raw, training.obs_moments)))[0]

    assert np.abs(training.obs_moments.mean - moments.mean).min() > 0.5
    torch.testing.assert_close(after, before, atol=1e-3, rtol=0)


def test_a_correction_stays_with_its_observation():
    training = make_training(ppo=PPO.model_copy(update={"precision": "float32"}))
    rollouts = []
    for rollout in dataset(0):
        corrections = np.repeat(rollout.obs[..., :1], 7, axis=-1)
        rollouts.append(replace(rollout, corrections=corrections))
    data = training.read(rollouts).data

    assert data.corrections.shape == data.actions.shape
    raw = np.concatenate([r.obs.reshape(-1, 37) for r in rollouts])
    np.testing.assert_array_equal(data.corrections.numpy(), np.repeat(raw[:, :1], 7, axis=1))
    np.testing.assert_allclose(data.obs[:, 0].numpy(), np.clip(raw[:, 0], -5, 5), rtol=1e-4)


def test_after_distillation_a_policy_learns_from_rewards_with_small_steps_and_no_late_corrections():
    training = make_training()
    training.teacher = TeacherConfig(policy="somewhere", epochs=2)
    rollout = [make_rollout(k, corrections=np.ones((16, 8, 7), np.float32)) for k in range(2)]
    rates = [training.run_epoch(rollout).update.learning_rate for _ in range(2)]
    late = training.read([rollout[0], make_rollout(2, version=2, corrections=rollout[0].corrections)]).data
    after = training.run_epoch(rollout).update

    assert rates == pytest.approx(
        [PPO.learning_rate, 0.5 * (PPO.learning_rate + PPO.learning_rate_min)]
    )  # linear over the two epochs
    np.testing.assert_array_equal(late.corrections[:128], 0.0)
    np.testing.assert_array_equal(late.corrections[128:], 1.0)
    assert after.correction_loss == 0.0
    assert after.policy_loss != 0.0


def test_two_threads_reach_what_one_reaches():
    before = torch.get_num_threads()
    trained = []
    try:
        for threads in (1, 2):
            training = make_training(ppo=PPO.model_copy(update={"precision": "float32", "threads": threads}))
            assert torch.get_num_threads() == threads
            for epoch in range(2):
                training.run_epoch([make_rollout(seed=epoch, envs=32)])
            trained.append(torch.cat([p.detach().ravel() for p in training.network.parameters()]))
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(trained[0], trained[1], rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("schedule", ["adaptive", "constant_then_linear"])
@pytest.mark.parametrize("teacher", [TeacherConfig(), TeacherConfig(policy="somewhere", epochs=1000)])
def test_each_rollback_halves_the_learning_rate_whatever_decides_it(schedule, teacher):
    training = make_training(ppo=PPO.model_copy(update={"schedule": schedule}))
    training.teacher = teacher
    training.run_epoch(dataset(0))
    mode = UpdateMode.DISTILL if teacher.policy else UpdateMode.PPO
    before = training._rate(mode, PPO.learning_rate_max)
    for _ in range(2):
        training.go_back(lambda _: None)

    assert training._rate(mode, PPO.learning_rate_max) == pytest.approx(before / 4)
    assert training._rate(UpdateMode.CRITIC_ONLY, PPO.learning_rate_min) == PPO.learning_rate_min
