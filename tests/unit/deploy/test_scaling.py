import pytest

from common.errors import ReportedError
from common.service.run_folder import RunFolder
from deploy.scaling import ask, changes, wanted


@pytest.fixture
def folder(tmp_path):
    found = RunFolder(tmp_path / "night")
    found.create()
    return found


@pytest.mark.parametrize(
    ("present", "actors", "expected"),
    [
        ([0, 1], 2, ([], [])),
        ([0, 1], 4, ([2, 3], [])),
        ([0, 1, 2, 3], 1, ([], [1, 2, 3])),
        ([1, 5], 3, ([0, 2], [5])),
    ],
)
def test_the_first_actors_remain(present, actors, expected):
    assert changes(present, actors) == expected


def test_what_is_asked_for_is_read(folder):
    folder.targets.touch()
    with folder.held_by("deploy.local"):
        ask(folder, 6)

    assert wanted(folder) == 6


def test_a_run_that_starts_or_is_measured_at_its_end_promises_no_actors(folder):
    """Nobody would read the wish."""
    with folder.held_by("deploy.local"), pytest.raises(ReportedError, match="night is starting or ending"):
        ask(folder, 6)

    assert wanted(folder) is None


def test_a_run_that_does_not_run_is_refused(folder):
    with pytest.raises(ReportedError, match=r"no topspin train keeps the run .*night"):
        ask(folder, 6)

    assert wanted(folder) is None


@pytest.mark.parametrize("text", ["", "0", "-1", "6.5", "1001", "9" * 5000, "six", "\xff"])
def test_a_number_that_is_not_allowed_is_no_wish(folder, text):
    folder.wanted_actors.write_text(text, encoding="latin-1")

    assert wanted(folder) is None


def test_an_actor_without_a_certificate_is_refused(folder, tmp_path):
    certificates = tmp_path / "certs"
    certificates.mkdir()
    for number in range(2):
        (certificates / f"actor-{number}.pem").touch()
    folder.config.write_text(f'tls = "{certificates}"')
    folder.targets.touch()
    with folder.held_by("deploy.local"):
        ask(folder, 2)
        with pytest.raises(ReportedError, match=r"actor-2 has no certificate .* --add actor-2"):
            ask(folder, 4)

    assert wanted(folder) == 2
