import pytest

from common.comms.messages import Place
from services.actor.joining import NoPlaceError, settings_of


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
