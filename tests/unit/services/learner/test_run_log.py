"""A run's two records, metrics.csv and TensorBoard's events, where a run is resumed."""

import logging
import math
from importlib.metadata import EntryPoint

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import services.learner.scalars as scalars_module
from common.errors import ConfigError, ReportedError
from common.service.table import Table, whole_rows
from services.evaluator.service import CURVE
from services.learner.epoch_stats import EpochStats, Progress, merged, play_counts
from services.learner.ppo import UpdateStats
from services.learner.run_log import RunLog, RunLogError, row
from services.learner.scalars import own_writers, scalars
from tests.unit.services.learner.rollouts import make_rollout


def run_log(folder, *writers):
    return RunLog(folder / "metrics.csv", folder / "tb", folder / "evaluations.csv", writers)


def logged(folder, epochs, **more):
    log = run_log(folder)
    for epoch in epochs:
        log.append({"epoch": epoch, "frames": 100 * epoch, "kl": 0.01 * epoch, **more})
    log.close()


def in_table(folder):
    return [(int(row["frames"]), round(float(row["kl"]), 3)) for row in whole_rows(folder / "metrics.csv")]


def curves(folder):
    """Return TensorBoard's curves by name: steps and values."""
    events = EventAccumulator(str(folder / "tb"), purge_orphaned_data=False)
    events.Reload()
    return {
        tag: [(event.step, round(event.value, 3)) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }


def in_tensorboard(folder):
    return curves(folder).get("update/kl", [])


def test_after_a_resume_that_rolled_back_both_records_tell_the_same(tmp_path):
    logged(tmp_path, range(1, 4))
    logged(tmp_path, range(4, 9))
    (tmp_path / "tb" / "events.out.tfevents.9999999999.of_a_process_that_was_killed_at_once").touch()
    run_log(tmp_path).truncate(3, 300)
    cut = in_tensorboard(tmp_path)
    logged(tmp_path, [4, 5])

    assert cut == [(100 * n, 0.01 * n) for n in (1, 2, 3)]
    assert in_tensorboard(tmp_path) == in_table(tmp_path) == [(100 * n, 0.01 * n) for n in range(1, 6)]


def test_a_file_of_events_is_cut_within(tmp_path):
    logged(tmp_path, range(1, 9))
    run_log(tmp_path).truncate(3, 300)

    assert in_tensorboard(tmp_path) == in_table(tmp_path) == [(100 * n, 0.01 * n) for n in (1, 2, 3)]


def test_a_run_that_begins_again_keeps_no_row_in_either(tmp_path):
    logged(tmp_path, [1, 2])
    run_log(tmp_path).truncate(0, -1)

    assert in_table(tmp_path) == []
    assert list((tmp_path / "tb").iterdir()) == []


def test_a_resume_moves_lines_that_are_no_rows_aside_and_names_them(tmp_path, caplog):
    (tmp_path / "metrics.csv").write_text("epoch,frames,kl\n1,100,0.01\n\nnonsense\n2,200\n3,300,0.03\n4,4")
    with caplog.at_level(logging.WARNING):
        run_log(tmp_path).truncate(3, 300)

    assert in_table(tmp_path) == [(100, 0.01), (300, 0.03)]
    assert (tmp_path / "metrics.refused.csv").read_text() == "nonsense\n2,200\n4,4\n"
    assert [record.args[2] for record in caplog.records] == [4, 5, 7]


def test_a_resume_goes_on_with_the_columns_of_an_earlier_release(tmp_path):
    (tmp_path / "metrics.csv").write_text("epoch,loss,frames\n1,0.5,100\n2,0.25,200\n")
    run_log(tmp_path).truncate(1, 100)
    logged(tmp_path, [2])

    assert whole_rows(tmp_path / "metrics.csv") == [
        {"epoch": "1", "frames": "100", "kl": "", "loss": "0.5"},
        {"epoch": "2", "frames": "200", "kl": "0.02", "loss": ""},
    ]


def test_a_file_that_is_no_table_of_epochs_is_refused_and_stays(tmp_path):
    (tmp_path / "metrics.csv").write_text("name\tvalue\n1\t2\n")

    with pytest.raises(RunLogError, match=r"metrics.csv:1: no column epoch; got name\tvalue"):
        run_log(tmp_path).truncate(3, 300)
    assert (tmp_path / "metrics.csv").read_text() == "name\tvalue\n1\t2\n"


def test_every_column_of_a_row_is_a_curve_once_and_no_name_says_its_group_twice():
    update = UpdateStats(*[0.5] * 11, True)
    stats = EpochStats(Progress(), update, merged(play_counts([make_rollout()])[None]), False, "", 0.0, 1)
    values = row(stats, 1.0, 2.0)
    names = scalars(dict.fromkeys(values, 1.0))

    assert len(names) == len(values) - len({"epoch", "frames", "seconds", "rallies", "unvalidated"})
    for name in names:
        group, _, rest = name.partition("/")
        assert not rest.startswith(group), name


def test_outcomes_are_shares_of_the_rallies_and_what_is_not_known_is_no_point():
    found = scalars({"rallies": 8, "outcome_net": 2, "return_rate": 0.5, "target_error": math.nan})

    assert found == {"outcome/net": 0.25, "play/return_rate": 0.5}
    assert scalars({"rallies": 0, "outcome_net": 0}) == {}


def test_evaluations_are_curves_beside_those_of_the_training(tmp_path):
    table = Table(tmp_path / "evaluations.csv", CURVE)
    log = run_log(tmp_path)
    log.append({"epoch": 1, "frames": 100, "kl": 0.1})
    table.append({"frames": 50, "return_rate": 0.25, "target_error_mean": None})
    log.append({"epoch": 2, "frames": 200, "kl": 0.1})
    table.append({"frames": 150, "return_rate": 0.5, "target_error_mean": 0.3})
    table.append({"frames": 900, "return_rate": 0.9})  # of a policy that a restart has taken back
    log.append({"epoch": 3, "frames": 300, "kl": 0.1})
    log.append({"epoch": 4, "frames": 1000, "kl": 0.1})
    log.close()
    found = curves(tmp_path)
    log = run_log(tmp_path)
    log.truncate(2, 200)
    log.append({"epoch": 3, "frames": 300, "kl": 0.1})
    log.close()

    assert found["evaluation/return_rate"] == [(50, 0.25), (150, 0.5)]
    assert found["evaluation/target_error"] == [(150, 0.3)]
    assert curves(tmp_path)["evaluation/return_rate"] == [(50, 0.25), (150, 0.5)]  # each once


WRITER = """
class Lines:
    def __init__(self, run, folder):
        self.file = (folder / "lines.txt").open("w")
        self.file.write(f"run {run}\\n")
    def write(self, frames, scalars):
        self.file.write(f"{frames} {sorted(scalars.items())}\\n")
    def close(self):
        self.file.close()
"""


def test_an_installed_package_offers_a_writer_of_its_own(tmp_path, monkeypatch):
    (tmp_path / "my_lines.py").write_text(WRITER)
    installed = tmp_path / "my_lines-1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: my-lines\nVersion: 1\n")
    (installed / "entry_points.txt").write_text("[topspin.writers]\nlines = my_lines:Lines\n")
    monkeypatch.syspath_prepend(tmp_path)
    log = run_log(tmp_path, *own_writers(["lines"], "night", tmp_path))
    log.append({"epoch": 1, "frames": 100, "kl": 0.5})
    log.close()

    assert (tmp_path / "lines.txt").read_text() == "run night\n100 [('update/kl', 0.5)]\n"
    with pytest.raises(
        ConfigError, match=r"writers 'comet': no entry point .* topspin.writers; allowed: .*lines"
    ):
        own_writers(["comet"], "night", tmp_path)


class Down:
    """A writer whose program is not reachable."""

    def __init__(self, run, folder):
        if folder is not None:
            raise OSError("tracker: no answer")

    def write(self, frames, scalars):
        raise OSError("tracker: no answer")

    def close(self):
        pass


def test_a_writers_error_says_what_it_was_and_training_goes_on(tmp_path, caplog):
    log = run_log(tmp_path, Down("night", None))
    log.append({"epoch": 1, "frames": 100, "kl": 0.5})
    log.close()

    assert "reason=tracker: no answer" in caplog.text
    assert in_table(tmp_path) == [(100, 0.5)]


def test_a_writer_that_cannot_begin_ends_the_run_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(
        scalars_module, "entry_points", lambda group: [EntryPoint("down", f"{__name__}:Down", group)]
    )

    with pytest.raises(ReportedError, match=r"^writer down can't begin: tracker: no answer$"):
        own_writers(["down"], "night", tmp_path)


def test_a_clock_that_was_set_back_between_two_lives_hides_no_file_from_the_cut(tmp_path):
    logged(tmp_path, range(1, 4))
    (first,) = (tmp_path / "tb").iterdir()
    first.rename(first.with_name("events.out.tfevents.9999999999.host"))  # the newest name, the oldest steps
    logged(tmp_path, range(4, 9))
    run_log(tmp_path).truncate(5, 500)

    assert (
        sorted(in_tensorboard(tmp_path)) == in_table(tmp_path) == [(100 * n, 0.01 * n) for n in range(1, 6)]
    )
