"""The end of a run: its table, and the commands that go on from it."""

import shlex
from threading import Event

import pytest

from common.errors import HelpRequest
from common.service.run_folder import RunFolder
from deploy.config import DeployConfig
from deploy.prepare import PreparedRun, link_to_learner
from deploy.summary import next_commands, table
from topspin.__main__ import dispatch

FOUND = {
    "run": "night",
    "policy": "runs/night/policy/latest",
    "frames": 60_000_000,
    "stage": 3,
    "seconds": 1881.0,
    "ledger": {"published": 7324, "trained": 7320, "refused": 4, "lost": 0},
}
MEASURED = {"return_rate": 0.902, "target_error_mean": 0.158, "rallies": 1000}


def a_run(folder, name="night", **settings):
    config = DeployConfig(**settings)
    return PreparedRun(name, config, RunFolder(folder), link_to_learner(config, "tcp/127.0.0.1:1"))


def trained(folder, frames, seconds):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.csv").write_text(f"epoch,frames,seconds\n7,{frames},{seconds}\n")


def test_the_table_has_rate_error_stage_frames_minutes_and_ledger():
    text = table(FOUND | MEASURED, RunFolder.of("night"))

    for part in (
        "return rate   90.2 % of 1,000 rallies",
        "target error  0.16 m",
        "stage         3 aim",
        "60,000,000 frames, 31.4 min",
        "published 7,324   trained 7,320   refused 4   lost 0",
        "runs/night",
    ):
        assert part in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_run_that_was_not_measured_or_returned_nothing_has_no_invented_figures():
    assert "return rate" not in table(FOUND, RunFolder.of("night"))
    nothing = {"return_rate": 0.0, "target_error_mean": None, "rallies": 40}
    assert "target error  -\n" in table(FOUND | nothing | {"ledger": {}}, RunFolder.of("night"))


@pytest.mark.parametrize(
    ("settings", "frames", "seconds", "more"),
    [
        ({"minutes": 10.0}, 5000, 599.5, " --minutes 20"),
        ({"frames": 5000}, 5000, 10.0, " --frames 10000"),
        ({"frames": 5000}, 4000, 10.0, ""),
        ({}, 120_000_000, 10.0, " --learner.curriculum.stage-3 234000000"),
        # both limits are spent: one alone would leave nothing to train
        (
            {"frames": 120_000_000},
            120_000_000,
            10.0,
            " --frames 240000000 --learner.curriculum.stage-3 237000000",
        ),
    ],
)
def test_going_on_gives_a_run_whose_budget_is_spent_more_of_it(tmp_path, settings, frames, seconds, more):
    trained(tmp_path, frames, seconds)

    text = next_commands(a_run(tmp_path, **settings), "topspin train")

    assert f"go on   topspin train --run night --resume{more}\n" in text


def test_the_next_commands_are_ones_that_the_program_takes(tmp_path):
    (tmp_path / "my run" / "policy" / "best").mkdir(parents=True)
    lines = next_commands(a_run(tmp_path / "my run", "my run"), "topspin train").splitlines()[1:]

    assert [line.split()[0] for line in lines] == ["film", "go", "report"]
    for line in (lines[0], lines[2]):
        words = shlex.split(line[line.index("topspin") :])
        with pytest.raises(HelpRequest):
            dispatch([*words[1:], "--print-config"], Event())
    assert "policy/best" in lines[0]


def test_without_a_best_policy_the_newest_is_filmed_and_reported(tmp_path):
    text = next_commands(a_run(tmp_path), "topspin train")

    assert "policy/latest --video" in text
    assert "report  topspin report night --policy latest" in text
