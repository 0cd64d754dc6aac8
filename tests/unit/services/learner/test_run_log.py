"""A run's two records, metrics.csv and TensorBoard's events, where a run is resumed."""

import logging

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from common.service.table import whole_rows
from services.learner.run_log import RunLog, RunLogError


def logged(folder, epochs, **more):
    log = RunLog(folder / "metrics.csv", folder / "tb")
    for epoch in epochs:
        log.append({"epoch": epoch, "frames": 100 * epoch, "kl": 0.01 * epoch, **more})
    log.close()


def in_table(folder):
    return [(int(row["frames"]), round(float(row["kl"]), 3)) for row in whole_rows(folder / "metrics.csv")]


def in_tensorboard(folder):
    events = EventAccumulator(str(folder / "tb"), purge_orphaned_data=False)
    events.Reload()
    tags = events.Tags()["scalars"]
    return [(event.step, round(event.value, 3)) for tag in tags for event in events.Scalars(tag)]


def test_after_a_resume_that_rolled_back_both_records_tell_the_same(tmp_path):
    logged(tmp_path, range(1, 4))
    logged(tmp_path, range(4, 9))
    (tmp_path / "tb" / "events.out.tfevents.9999999999.of_a_process_that_was_killed_at_once").touch()
    RunLog(tmp_path / "metrics.csv", tmp_path / "tb").truncate(3, 300)
    cut = in_tensorboard(tmp_path)
    logged(tmp_path, [4, 5])

    assert cut == [(100 * n, 0.01 * n) for n in (1, 2, 3)]
    assert in_tensorboard(tmp_path) == in_table(tmp_path) == [(100 * n, 0.01 * n) for n in range(1, 6)]


def test_a_file_of_events_is_cut_within(tmp_path):
    logged(tmp_path, range(1, 9))
    RunLog(tmp_path / "metrics.csv", tmp_path / "tb").truncate(3, 300)

    assert in_tensorboard(tmp_path) == in_table(tmp_path) == [(100 * n, 0.01 * n) for n in (1, 2, 3)]


def test_a_run_that_begins_again_keeps_no_row_in_either(tmp_path):
    logged(tmp_path, [1, 2])
    RunLog(tmp_path / "metrics.csv", tmp_path / "tb").truncate(0, -1)

    assert in_table(tmp_path) == []
    assert list((tmp_path / "tb").iterdir()) == []


def test_a_resume_moves_lines_that_are_no_rows_aside_and_names_them(tmp_path, caplog):
    (tmp_path / "metrics.csv").write_text("epoch,frames,kl\n1,100,0.01\n\nnonsense\n2,200\n3,300,0.03\n4,4")
    with caplog.at_level(logging.WARNING):
        RunLog(tmp_path / "metrics.csv", tmp_path / "tb").truncate(3, 300)

    assert in_table(tmp_path) == [(100, 0.01), (300, 0.03)]
    assert (tmp_path / "metrics.refused.csv").read_text() == "nonsense\n2,200\n4,4\n"
    assert [record.args[2] for record in caplog.records] == [4, 5, 7]


def test_a_resume_goes_on_with_the_columns_of_an_earlier_release(tmp_path):
    (tmp_path / "metrics.csv").write_text("epoch,loss,frames\n1,0.5,100\n2,0.25,200\n")
    RunLog(tmp_path / "metrics.csv", tmp_path / "tb").truncate(1, 100)
    logged(tmp_path, [2])

    assert whole_rows(tmp_path / "metrics.csv") == [
        {"epoch": "1", "frames": "100", "kl": "", "loss": "0.5"},
        {"epoch": "2", "frames": "200", "kl": "0.02", "loss": ""},
    ]


def test_a_file_that_is_no_table_of_epochs_is_refused_and_stays(tmp_path):
    (tmp_path / "metrics.csv").write_text("name\tvalue\n1\t2\n")

    with pytest.raises(RunLogError, match=r"metrics.csv:1: no column epoch; got name\tvalue"):
        RunLog(tmp_path / "metrics.csv", tmp_path / "tb").truncate(3, 300)
    assert (tmp_path / "metrics.csv").read_text() == "name\tvalue\n1\t2\n"
