"""A whole run in one process: generator, two actors, learner and evaluator over real Zenoh."""

import csv
import json
import shutil

import pytest
import torch

from common.policy.folder import load_policy
from common.task.experience import ExperienceConfig
from services.learner.config import CurriculumConfig
from tests.integration.in_process_run import CURRICULUM, DATASET, PPO, local_run
from tests.unit.env.teachers import write_teacher
from tests.waiting import wait_until

FATES = ("trained", "refused", "dropped", "in_flight", "lost")


def ledger(scraped):
    return {fate: scraped[f'topspin_ledger_rollouts{{fate="{fate}"}}'] for fate in ("published", *FATES)}


def test_a_run_goes_through_its_stages_and_every_rollout_is_accounted_for(tmp_path):
    with local_run(tmp_path) as s:
        learner = s.learner()  # the hub: it must listen before the others connect
        evaluator = s.evaluator()  # it asks for the policy before anything is trained
        generator, actors = s.generator(), [s.actor(0), s.actor(1)]
        wait_until(lambda: learner.service.training.progress.stage == 3, 60, "stage 3")
        wait_until(
            lambda: all(actor.scrape()["topspin_stage"] == 3 for actor in actors),
            20,
            "both actors in stage 3",
        )
        wait_until(lambda: evaluator.service.evaluations >= 1, 30, "an evaluation")
        scraped = [entry.scrape() for entry in (generator, *actors, learner, evaluator)]
        learner.join(60)
        for entry in (*actors, evaluator, generator):
            entry.end()
        progress, final = learner.service.training.progress, learner.service.ledger()

    assert all(any(name.startswith("topspin_process_up") for name in metrics) for metrics in scraped)
    seen = ledger(scraped[3])
    assert seen["published"] == sum(seen[fate] for fate in FATES)
    assert final.balance == 0
    assert (final.lost, final.dropped) == (0, 0)
    assert final.trained == 2 * 8
    assert (progress.epoch, progress.stage, progress.stage_number) == (8, 3, 2)
    with (tmp_path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    # a row has the stage after its epoch: the third of stage 1 already has stage 2
    assert [int(row["stage"]) for row in rows] == [1, 1, 2, 2, 3, 3, 3, 3]
    assert max(float(row["lag"]) for row in rows) <= 2
    assert load_policy(tmp_path / "policy" / "latest").contract.version == 8
    assert (
        json.loads((tmp_path / "policy" / "best" / "contract.json").read_text())["measures"]["rallies"] == 20
    )
    with (tmp_path / "report" / "evaluations.csv").open() as file:
        assert min(int(row["frames"]) for row in csv.DictReader(file)) > 0  # never the untrained policy
    assert load_policy(tmp_path / "policy" / "best").contract.frames > 0
    assert list((tmp_path / "tb").iterdir())


def test_a_run_with_the_papers_switches_changes_stages_by_frames_and_saves_its_newest_weights(tmp_path):
    curriculum = CurriculumConfig(stage_shares=(0.375, 0.25, 0.375), count_reset="raw")
    ppo = PPO.model_copy(update={"schedule": "constant_then_linear", "refit_frames": 0})
    with local_run(
        tmp_path, curriculum=curriculum, ppo=ppo, frames=8 * DATASET, evaluated_weights="newest"
    ) as s:
        learner = s.learner()
        generator, actors, evaluator = s.generator(), [s.actor(0), s.actor(1)], s.evaluator()
        learner.join(60)
        for entry in (*actors, evaluator, generator):
            entry.end()
        training, final = learner.service.training, learner.service.ledger()
    with (tmp_path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    saved = load_policy(tmp_path / "policy" / "latest")

    assert [int(row["stage"]) for row in rows] == [1, 1, 2, 2, 3, 3, 3, 3]
    assert [float(row["learning_rate"]) for row in rows] == pytest.approx(
        [5e-4] * 6 + [5e-4 - k / 3 * 4.8e-4 for k in (1, 2)]
    )
    assert final.balance == final.lost == 0
    assert torch.equal(saved.network.log_std, training.network.log_std)
    assert not torch.equal(saved.network.log_std, training.average.log_std)


def test_a_run_with_a_teacher_imitates_it_first_and_then_learns_from_rewards(tmp_path):
    teacher = write_teacher(tmp_path / "teacher").model_copy(update={"epochs": 3})
    experience = ExperienceConfig(teacher=teacher)
    curriculum = CURRICULUM.model_copy(update={"first_stage": 3, "stage_3": 6 * DATASET})
    with local_run(tmp_path / "run", curriculum=curriculum) as s:
        learner = s.learner(experience=experience)
        generator, actors = s.generator(), [s.actor(k, experience=experience) for k in range(2)]
        learner.join(60)
        for entry in (*actors, generator):
            entry.end()
        ledger = learner.service.ledger()
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    shutil.rmtree(tmp_path / "teacher")
    with local_run(tmp_path / "run", curriculum=curriculum) as s:  # a resume needs the teacher no more
        resumed = s.learner(run=False, experience=experience, resume=True)

    taught, later = rows[:3], rows[3:]
    assert later
    assert all(float(row["correction_loss"]) > 0 and float(row["policy_loss"]) == 0 for row in taught)
    assert all(float(row["policy_loss"]) != 0 for row in later)
    assert resumed.service.training.progress.epoch == len(rows)
    assert ledger.refused == {}
    assert ledger.balance == ledger.lost == 0
