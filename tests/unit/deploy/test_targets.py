import json

import pytest

from common.comms.messages import Status
from deploy.targets import TargetsFile, reachable

NAMES = ("learner-0", "actor-0", "actor-1")


def a_status(role, id_, **gauges):
    return Status(role, id_, 1, 1.8e9, "playing", {}, gauges)


HEARD = [a_status("actor", "1", metrics_port=9103.0), a_status("learner", "0", metrics_port=9100.0)]


@pytest.fixture
def targets(tmp_path):
    return TargetsFile(tmp_path / "targets.json", "night", "127.0.0.1")


def test_the_file_has_an_address_and_three_labels_for_each_service_that_was_heard(targets, tmp_path):
    targets.update([*HEARD, a_status("actor", "0"), a_status("actor", "8", metrics_port=9100.0)], NAMES)

    assert json.loads((tmp_path / "targets.json").read_text()) == [
        {"targets": ["127.0.0.1:9100"], "labels": {"run": "night", "role": "learner", "id": "0"}},
        {"targets": ["127.0.0.1:9103"], "labels": {"run": "night", "role": "actor", "id": "1"}},
    ]


def test_a_port_that_changes_is_written_and_the_file_ends_with_the_run(targets, tmp_path):
    targets.update(HEARD, NAMES)
    targets.update([a_status("actor", "1", metrics_port=9111.0)], NAMES)
    text = (tmp_path / "targets.json").read_text()
    targets.close()
    targets.close()

    assert "127.0.0.1:9111" in text
    assert not list(tmp_path.iterdir())


def test_the_log_says_the_ports_once_all_services_have_come(targets, caplog):
    with caplog.at_level("INFO"):
        targets.update(HEARD, NAMES)
        assert not caplog.text
        targets.update([*HEARD, a_status("actor", "0", metrics_port=9102.0)], NAMES)

    assert [record.getMessage() for record in caplog.records] == [
        f"metrics host=127.0.0.1 learner-0=9100 actor-0=9102 actor-1=9103; for Prometheus: file={targets._path}"
    ]


def test_a_folder_that_cant_be_written_costs_a_line_and_is_tried_again(tmp_path, caplog):
    targets = TargetsFile(tmp_path / "gone" / "targets.json", "night", "127.0.0.1")
    targets.update(HEARD, NAMES)
    targets.update(HEARD, NAMES)
    assert caplog.text.count("can't write file=") == 1

    (tmp_path / "gone").mkdir()
    targets.update(HEARD, NAMES)
    assert len(json.loads((tmp_path / "gone" / "targets.json").read_text())) == 2


@pytest.mark.parametrize(
    ("host", "found"), [("127.0.0.1", "127.0.0.1"), ("::1", "[::1]"), ("10.0.0.7", "10.0.0.7")]
)
def test_services_are_reached_where_they_serve(host, found):
    assert reachable(host) == found


def test_services_that_serve_at_every_address_are_reached_by_the_machines_name(monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "host-a")

    assert reachable("0.0.0.0") == "host-a"
