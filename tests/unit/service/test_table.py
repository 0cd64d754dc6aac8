"""Rows of a table, where the disk is full for a while."""

import logging

from common.service.run_folder import whole_rows
from common.service.table import Table
from tests.full_disk import files_up_to


def test_rows_that_could_not_be_written_follow_in_order(tmp_path, caplog):
    file = tmp_path / "rows.csv"
    table = Table(file, ("epoch", "loss"))
    table.append({"epoch": 1, "loss": 0.5})
    whole = file.read_text()
    with caplog.at_level(logging.INFO), files_up_to(len(whole) + 3):
        for epoch in (2, 3):
            table.append({"epoch": epoch, "loss": 0.25})
        full = file.read_text()
        waiting = table.waiting
    with caplog.at_level(logging.INFO):
        table.append({"epoch": 4, "loss": 0.125, "other": 7})

    assert full == whole  # no part of a row
    assert waiting == 2
    assert [row["epoch"] for row in whole_rows(file)] == ["1", "2", "3", "4"]
    assert table.waiting == 0
    assert [record.levelname for record in caplog.records] == ["ERROR", "INFO"]


def test_the_header_follows_too(tmp_path):
    table = Table(tmp_path / "rows.csv", ("epoch",))
    with files_up_to(0):
        table.append({"epoch": 1})
    table.append({"epoch": 2})

    assert (tmp_path / "rows.csv").read_text().split() == ["epoch", "1", "2"]


def test_an_existing_table_is_continued_without_a_second_header(tmp_path):
    Table(tmp_path / "rows.csv", ("epoch",)).append({"epoch": 1})
    Table(tmp_path / "rows.csv", ("epoch",)).append({"epoch": 2})

    assert (tmp_path / "rows.csv").read_text().split() == ["epoch", "1", "2"]
