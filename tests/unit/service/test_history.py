import json

from common.service import history
from common.service.history import History
from tests.full_disk import files_up_to


def events(file):
    return [json.loads(line)["n"] for line in file.read_text().splitlines()]


def test_a_full_disk_costs_no_line(tmp_path, caplog):
    written = History(str(tmp_path), "actor-0")
    file = tmp_path / "actor-0.jsonl"
    written.note("sent", n=0)
    with files_up_to(file.stat().st_size + 5):  # room for a part of a line
        for n in range(1, 50):
            written.note("sent", n=n)
        assert file.stat().st_size < 100
    written.note("sent", n=50)
    written.close()

    assert events(file) == list(range(51))
    assert [record.getMessage().split(" file=")[0] for record in caplog.records] == [
        "the history waits for its disk"
    ]


def test_lines_that_wait_at_the_end_are_written_then(tmp_path):
    written = History(str(tmp_path), "actor-0")
    with files_up_to(0):
        written.note("sent", n=0)
    written.close()

    assert events(tmp_path / "actor-0.jsonl") == [0]


def test_a_disk_that_stays_full_ends_the_history_with_one_line_and_not_the_service(
    tmp_path, caplog, monkeypatch
):
    monkeypatch.setattr(history, "MOST_WAITING", 1000)
    written = History(str(tmp_path), "actor-0")
    with files_up_to(0):
        for n in range(100):
            written.note("sent", n=n)
    written.note("sent", n=100)
    written.close()

    assert (tmp_path / "actor-0.jsonl").read_text() == ""
    assert sum("the history ends" in record.getMessage() for record in caplog.records) == 1
