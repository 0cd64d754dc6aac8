"""`topspin certs`."""

import stat
from pathlib import Path
from threading import Event

import pytest

from common.comms.certificates import CertificateError, checked, names_in
from common.comms.keys import KeyPartError
from topspin.certs import main

NAMES = ("actor-0", "actor-1", "evaluator-0", "generator-0", "learner-0", "operator-0")


@pytest.fixture
def make(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *flags: main(flags, Event())


def test_every_service_of_a_run_gets_a_certificate_that_only_its_owner_can_read(make):
    make("--actors", "2")
    files = list(Path("certs").iterdir())

    assert names_in("certs") == NAMES
    for name in NAMES:
        checked("certs", name)
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
    assert len(files) == 2 * (len(NAMES) + 1)


def test_names_are_added_to_a_folder_and_nothing_is_overwritten(make):
    make()
    before = {file: file.read_bytes() for file in Path("certs").iterdir()}
    make("--add", "actor-8,generator-lab")
    for flags in ((), ("--add", "actor-9,actor-8")):
        with pytest.raises(
            CertificateError, match=r"exists already, and nothing is overwritten; choose another --out"
        ):
            make(*flags)

    assert all(file.read_bytes() == content for file, content in before.items())
    assert {"actor-8", "generator-lab"} < set(names_in("certs"))
    assert "actor-9" not in names_in("certs")
    checked("certs", "generator-lab")


def test_what_cannot_be_made_is_refused_before_anything_is_written(make):
    with pytest.raises(
        CertificateError, match=r"there is no certs/ca.key to sign with; make a folder without --add"
    ):
        make("--add", "actor-1")
    for name in ("umpire-0", "actor", "actor-a/b", "../actor-0"):
        with pytest.raises(KeyPartError, match="allowed"):
            make("--add", name)

    assert not Path("certs").exists()
