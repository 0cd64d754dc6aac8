"""Which trainings a size of datasets needs, and that what is measured stays."""

import json
from threading import Event

import pytest

from benchmarks import batch_sizes
from benchmarks.batch_sizes import BatchSizesConfig, flags_of, main, missing
from benchmarks.scaling.large_batches import Point, read
from common.errors import ReportedError
from deploy.config import settings

SIZES = (8192, 32_768, 131_072, 524_288)


@pytest.mark.parametrize("size", SIZES)
def test_the_flags_make_datasets_of_the_size_in_messages_of_64_mib_at_most(size):
    config = settings(("--run", "r", *flags_of(size, size // 4)), "p")
    rollout = config.actor.envs * config.actor.horizon

    assert config.actors * rollout == size
    assert 4 * config.learner.ppo.minibatch == size
    assert 400 * rollout < 64 * 2**20  # a frame has fewer bytes


@pytest.mark.parametrize("size", [0, 8200, 600_001])
def test_a_size_that_is_no_whole_number_of_rollouts_is_refused(size):
    with pytest.raises(ReportedError, match=f"^dataset of {size} frames; allowed: a multiple of "):
        flags_of(size, 2048)


def test_all_sizes_have_their_first_seed_before_one_has_its_second():
    config = BatchSizesConfig(sizes=(8192, 32_768), seeds=(3, 4))
    points = (Point(dataset=32_768, minibatch=8192, frames=None, limit=60_000_000, seed=3),)

    assert missing(config, points) == [(8192, 3), (8192, 4), (32_768, 4)]


@pytest.mark.parametrize(
    ("known", "is_done"),
    [
        ({"frames": 9_000_000, "limit": 20_000_000}, True),
        ({"frames": None, "limit": 60_000_000}, True),
        ({"frames": None, "limit": 20_000_000}, False),  # it may reach the goal with more
        ({"frames": 9_000_000, "limit": 60_000_000, "minibatch": 512}, False),
        ({"frames": 9_000_000, "limit": 60_000_000, "more": "--seed 7"}, False),
    ],
)
def test_only_a_training_of_the_same_rule_and_at_least_as_many_frames_is_known(known, is_done):
    config = BatchSizesConfig(sizes=(8192,), seeds=(0,))
    point = Point(**({"dataset": 8192, "minibatch": 2048, "seed": 0} | known))

    assert (missing(config, (point,)) == []) is is_done


@pytest.mark.parametrize("other", [{"minibatch": 512}, {"more": "--actor.horizon 64"}])
def test_another_rule_needs_a_file_of_its_own(other):
    with pytest.raises(ReportedError, match="allowed: another file, since this one is of one rule"):
        main(BatchSizesConfig(**other, train=False), Event())


def test_each_training_is_written_at_once_and_is_not_trained_again(tmp_path, monkeypatch, capsys):
    stop, asked = Event(), []

    def train(config, name, seed, stopped, resumes):
        assert resumes
        asked.append((name, seed, config.more))
        if len(asked) == 3:
            stopped.set()  # Ctrl-C in the third
            return None
        return {"reached": len(asked) == 1, "frames": 9_000_000}

    monkeypatch.setattr(batch_sizes, "train", train)
    config = BatchSizesConfig(
        sizes=(8192, 32_768),
        run="b",
        frames=20_000_000,
        minibatch=0,
        out=tmp_path / "found.json",
        json_line=True,
    )
    main(config, stop)
    first = read(config.out).points
    main(config, Event())

    assert [name for name, _, _ in asked] == ["b-8192-0", "b-32768-0", "b-8192-1", "b-8192-1", "b-32768-1"]
    assert (
        asked[0][2]
        == "--actors 2 --actor.envs 128 --actor.horizon 32 --learner.ppo.minibatch 2048 --frames 20000000"
    )
    assert first == (
        Point(dataset=8192, minibatch=2048, frames=9_000_000, limit=20_000_000, seed=0),
        Point(dataset=32_768, minibatch=8192, frames=None, limit=20_000_000, seed=0),  # it trained to its end
    )
    assert len(read(config.out).points) == 4
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [point["dataset"] for point in printed["points"]] == [8192, 32_768, 8192, 32_768]
