"""A learner that diverges goes back to a checkpoint, or ends with one line."""

import shutil

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from services.learner import training as training_module
from services.learner.checkpoint import checkpoints
from services.learner.keeper import DivergedError
from tests.integration.in_process_run import DATASET, LONG, local_run, progress
from tests.waiting import wait_until


def diverge_in_the_next_epoch(training):
    """Spoil the parameters within an epoch: between two of them the broken policy would be published, and refused."""
    train = training.run_epoch

    def run_epoch(*arguments):
        training.run_epoch = train
        with torch.no_grad():
            training.network.mean.weight[:] = float("nan")
        return train(*arguments)

    training.run_epoch = run_epoch


def test_a_run_that_diverges_goes_back_to_its_last_good_checkpoint_and_counts_it(tmp_path):
    with local_run(tmp_path, curriculum=LONG, checkpoint_interval_s=0.2) as s:
        learner = s.learner()
        s.generator()
        s.actor(0, shards=1)
        good = tmp_path / "checkpoints" / "good"
        wait_until(lambda: good.exists() and any(good.iterdir()), 60, "a good checkpoint")
        diverge_in_the_next_epoch(learner.service.training)
        wait_until(lambda: learner.metric("topspin_rollbacks_total") == 1, 30, "a rollback")
        version = progress(learner).version
        wait_until(lambda: progress(learner).version > version + 2, 30, "epochs after it")
        weights = learner.service.training.network.mean.weight

    assert progress(learner).rollbacks == 1
    assert bool(weights.isfinite().all())


def test_the_checkpoint_to_go_back_to_is_of_the_present_stage(tmp_path):
    with local_run(tmp_path, curriculum=LONG, checkpoint_interval_s=1000.0) as s:
        learner = s.learner()
        s.generator()
        s.actor(0, shards=1)
        begun = (LONG.stage_1 + LONG.stage_2) // DATASET
        wait_until(lambda: progress(learner).epoch > begun, 60, "stage 3")
        kept = [path.stem for path in checkpoints(tmp_path / "checkpoints" / "good")]

    assert kept == [f"{begun:08d}"]


def test_an_update_that_fails_leaves_the_last_checkpoint_as_it_is(tmp_path, monkeypatch):
    with local_run(tmp_path, curriculum=LONG, checkpoint_interval_s=0.01) as s:
        learner = s.learner()
        s.generator()
        s.actor(0, shards=1)
        wait_until(lambda: progress(learner).epoch >= 3, 60, "epochs")
        training, update = learner.service.training, training_module.update

        def failing(engine, *rest, **more):
            update(engine, *rest, **more)  # the parameters have moved
            raise MemoryError("out of memory")

        monkeypatch.setattr(training_module, "update", failing)
        with pytest.raises(MemoryError):
            learner.join(30)
        newest = checkpoints(tmp_path / "checkpoints")[-1]
        saved = load_file(newest)
        moved = {name: values.detach().numpy() for name, values in training.network.named_parameters()}

    assert int(newest.stem) == training.progress.version
    assert any(not np.array_equal(saved[f"network.{name}"], values) for name, values in moved.items())


def test_a_run_that_diverges_without_a_good_checkpoint_ends_with_one_line(tmp_path):
    with local_run(tmp_path, curriculum=LONG, checkpoint_interval_s=1000.0) as s:
        learner = s.learner()
        s.generator()
        s.actor(0, shards=1)
        # Each change of stage saves a checkpoint, and after the last one there is none for 1,000 s
        begun = (LONG.stage_1 + LONG.stage_2) // DATASET
        wait_until(lambda: progress(learner).epoch > begun + 1, 60, "stage 3")
        shutil.rmtree(tmp_path / "checkpoints" / "good", ignore_errors=True)
        diverge_in_the_next_epoch(learner.service.training)
        with pytest.raises(DivergedError, match="no good checkpoint to go back to"):
            learner.join(30)
        newest = checkpoints(tmp_path / "checkpoints")[-1]

    assert bool(np.isfinite(load_file(newest)["network.mean.weight"]).all())
