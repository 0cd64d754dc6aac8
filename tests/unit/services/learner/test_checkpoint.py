"""Checkpoints that are damaged: the newest whole one counts."""

import dataclasses
import logging
import os
import shutil

import numpy as np
import pytest

from common.policy.config import NetworkConfig
from services.learner import checkpoint
from services.learner.checkpoint import CheckpointError, DamagedCheckpointError, Extras
from services.learner.config import CurriculumConfig, PPOConfig
from services.learner.curriculum import StageLengths
from services.learner.training import Training

EXTRAS = Extras("r", 5, [], [], 1.5, closed=(("a", 3),), queue=(b"one", b"another"))


def make_training(units=(8, 8)):
    return Training(
        PPOConfig(), NetworkConfig(units=units), StageLengths(CurriculumConfig()), np.zeros(7, np.float32), 0
    )


def saved(folder, versions):
    training = make_training()
    for version in versions:
        training.progress = dataclasses.replace(training.progress, version=version)
        checkpoint.save(folder, training, EXTRAS)
    return checkpoint.checkpoints(folder)


def flip(path, at):
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def test_a_checkpoint_returns_what_the_service_kept(tmp_path):
    (path,) = saved(tmp_path, [7])

    assert checkpoint.restore(path, make_training()) == EXTRAS


@pytest.mark.parametrize("at", [-1, -2000, 700])
def test_one_flipped_bit_is_found(tmp_path, at):
    (path,) = saved(tmp_path, [7])
    flip(path, at)

    with pytest.raises(DamagedCheckpointError):
        checkpoint.restore(path, make_training())


def test_a_resume_goes_on_from_the_newest_whole_checkpoint_and_says_so(tmp_path, caplog):
    whole, cut, flipped = saved(tmp_path, [1, 2, 3])
    cut.write_bytes(cut.read_bytes()[:-100])
    flip(flipped, -1)
    training = make_training()
    with caplog.at_level(logging.WARNING):
        path, _ = checkpoint.restore_newest(tmp_path, training)

    assert path == whole
    assert training.progress.version == int(whole.stem)
    assert len(caplog.messages) == 2
    assert all(f"going on from file={whole}, the newest whole one" in line for line in caplog.messages)


def test_without_a_whole_checkpoint_the_error_names_each_fault(tmp_path):
    for path in saved(tmp_path, [1, 2]):
        path.write_bytes(b"")

    with pytest.raises(CheckpointError, match=r"no whole checkpoint there; .*00000002.*00000001"):
        checkpoint.restore_newest(tmp_path, make_training())


def test_a_checkpoint_of_another_network_is_not_passed_over(tmp_path):
    saved(tmp_path, [1, 2])

    with pytest.raises(CheckpointError, match="doesn't fit this configuration"):
        checkpoint.restore_newest(tmp_path, make_training(units=(4, 4)))


def test_the_good_checkpoint_is_a_file_of_its_own_with_the_modes_of_the_umask(tmp_path):
    before = os.umask(0o022)
    try:
        (path,) = saved(tmp_path, [7])
        checkpoint.keep(path, tmp_path / "good")
    finally:
        os.umask(before)
    (good,) = checkpoint.checkpoints(tmp_path / "good")

    assert good.stat().st_nlink == path.stat().st_nlink == 1
    assert oct(path.stat().st_mode & 0o777) == oct(good.stat().st_mode & 0o777) == "0o644"


def test_a_run_copied_without_its_links_is_resumed(tmp_path):
    path = saved(tmp_path / "run", [1, 2])[-1]
    checkpoint.keep(path, tmp_path / "run" / "good")
    shutil.copytree(tmp_path / "run", tmp_path / "copy")
    training = make_training()
    found, _ = checkpoint.restore_newest(tmp_path / "copy", training)
    checkpoint.keep(checkpoint.save(tmp_path / "copy", training, EXTRAS), tmp_path / "copy" / "good")

    assert found.name == path.name


def test_a_checkpoint_that_can_not_be_read_says_why(tmp_path):
    loop = tmp_path / "00000001.safetensors"
    loop.symlink_to(loop.name)

    with pytest.raises(CheckpointError, match=f"can't read checkpoint {loop}: Too many levels"):
        checkpoint.restore_newest(tmp_path, make_training())
