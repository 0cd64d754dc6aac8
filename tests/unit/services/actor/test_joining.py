from contextlib import nullcontext
from threading import Event

import pytest

from common.comms.messages import Place
from services.actor import joining
from services.actor.config import ActorConfig
from services.actor.joining import NoPlaceError, joined, settings_of


def place(settings):
    return Place(actor="3", index=3, settings=settings)


def test_settings_come_with_a_place():
    assert settings_of(place(b'seed = 3\n[task]\nlaunch = "strong"\n')) == {
        "seed": 3,
        "task": {"launch": "strong"},
    }


@pytest.mark.parametrize("settings", [b"\xff", b"actors = ", b"[" * 5000])
def test_settings_that_are_none_are_named(settings):
    with pytest.raises(NoPlaceError, match="the learner's settings are not TOML"):
        settings_of(place(settings))


@pytest.fixture
def join(monkeypatch):
    """Return what joins an actor with flags to a learner whose answer is that ``learners`` are its settings."""

    def settings_of_joined(learners, *argv):
        monkeypatch.setattr(joining, "connected", lambda *_: nullcontext((None, None)))
        monkeypatch.setattr(joining, "ask", lambda *_: place(learners))
        return joined(ActorConfig(), argv, "p", Event())

    return settings_of_joined


def test_what_an_actor_is_not_given_is_the_learners(join):
    found = join(b'seed = 3\n[task]\nlaunch = "strong"\n', "--task.randomization", "off")

    assert (found.id, found.index) == ("3", 3)
    assert (found.seed, found.task.launch, found.task.randomization) == (3, "strong", "off")


@pytest.mark.parametrize("by", ["flag", "environment"])
def test_an_actors_own_file_goes_before_the_learners_settings_and_takes_none_away(
    join, tmp_path, monkeypatch, by
):
    file = tmp_path / "own.toml"
    file.write_text('run = "night"\nendpoint = "tcp/far:7447"\nseed = 5\n')
    if by == "environment":
        monkeypatch.setenv("TOPSPIN_CONFIG", str(file))
    found = join(b'seed = 3\n[task]\nlaunch = "strong"\n', *(("--config", str(file)) if by == "flag" else ()))

    assert (found.run, found.endpoint) == ("night", "tcp/far:7447")
    assert (found.seed, found.task.launch) == (5, "strong")
