"""A run folder that can't be written for a while: training goes on, and what was saved before stays."""

import logging

import pytest

from services.learner import checkpoint
from services.learner.keeper import NotSavedError
from tests.full_disk import files_up_to
from tests.integration.in_process_run import LONG, local_run, progress
from tests.waiting import wait_until

LIMIT = 16_384  # bytes of a file: less than a checkpoint


def test_training_goes_on_while_no_checkpoint_can_be_written(tmp_path, caplog):
    with (
        local_run(tmp_path, curriculum=LONG, checkpoint_interval_s=0.05) as s,
        caplog.at_level(logging.ERROR),
    ):
        learner = s.learner()
        folder = learner.service._folder.checkpoints
        s.generator()
        actors = [s.actor(0), s.actor(1)]
        wait_until(lambda: checkpoint.checkpoints(folder), 60, "a checkpoint")
        with files_up_to(LIMIT):
            wait_until(lambda: learner.metric("topspin_failed_saves_total") >= 2, 20, "a failed save")
            before = checkpoint.checkpoints(folder)
            epoch = progress(learner).epoch
            wait_until(lambda: progress(learner).epoch >= epoch + 3, 20, "training to go on")
            during = checkpoint.checkpoints(folder)
        epoch = progress(learner).epoch
        wait_until(lambda: checkpoint.newest(folder).stem > f"{epoch:08d}", 20, "the next checkpoint")
        parts = list(folder.glob("*.part"))
        for actor in actors:
            actor.end()
        learner.end()

    assert before == during
    assert parts == []
    assert "can't be saved in" in caplog.text
    assert learner.service.ledger().balance == 0


def test_a_last_state_that_can_not_be_saved_ends_the_learner_with_one_line(tmp_path):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        actor = s.actor(0)
        other = s.actor(1)
        wait_until(lambda: progress(learner).epoch >= 2, 60, "training")
        for each in (actor, other):
            each.end()
        with files_up_to(LIMIT), pytest.raises(NotSavedError, match="can't be saved in"):
            learner.end()
