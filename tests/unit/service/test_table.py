"""Rows of a table, where the disk is full for a while."""

import logging

import pytest

from common.service.table import Table, whole_rows
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


def continued(file, text, encoding="utf-8"):
    """Return the rows of a file that held ``text`` after a row was added."""
    file.write_bytes(text.encode(encoding))
    Table(file, ("epoch", "loss")).append({"epoch": 3, "loss": 0.5})
    return [(row["epoch"], row["loss"]) for row in whole_rows(file)]


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("epoch,loss\n1,0.5\n2,0.25\n", "utf-8-sig"),
        ("epoch,loss\r\n1,0.5\r\n2,0.25\r\n", "utf-8"),
        ("epoch;loss\r\n1;0,5\r\n2;0,25\r\n", "utf-8-sig"),
        ("epoch,loss\n\n1,0.5\n\n2,0.25\n\n", "utf-8"),
        ("loss,epoch\n0.5,1\n0.25,2\n", "utf-8"),
        ("epoch,loss\n1,0.5\n2,0.25\n3,0.", "utf-8"),
    ],
)
def test_a_table_that_another_program_saved_is_continued(tmp_path, text, encoding):
    rows = continued(tmp_path / "rows.csv", text, encoding)

    assert rows == [("1", "0.5"), ("2", "0.25"), ("3", "0.5")]


def test_columns_of_an_earlier_release_stay_and_new_ones_are_added(tmp_path):
    rows = continued(tmp_path / "rows.csv", "epoch,old\n1,7\n2,8\n")

    assert rows == [("1", ""), ("2", ""), ("3", "0.5")]
    assert [row["old"] for row in whole_rows(tmp_path / "rows.csv")] == ["7", "8", ""]


def test_a_line_that_is_no_row_is_named_by_file_and_line(tmp_path, caplog):
    file = tmp_path / "rows.csv"
    file.write_text("epoch,loss\n1,0.5\n2,0.25,9\n3,many\n4,0.5\n")
    with caplog.at_level(logging.WARNING):
        rows = whole_rows(file)

    assert [row["epoch"] for row in rows] == ["1", "4"]
    assert [f"file={file} line={number} " in caplog.text for number in (2, 3, 4, 5)] == [
        False,
        True,
        True,
        False,
    ]
