"""Flags of the commands that measure a policy: none that would set nothing is taken."""

import re
from threading import Event

import pytest

from common.config import ConfigError, HelpRequest
from services.evaluator import play
from services.evaluator.__main__ import settings

NOBODY = re.escape("the policy's contract or the match sets it")


@pytest.mark.parametrize(
    ("flag", "value", "instead"),
    [
        ("--env.noise", "off", "give --noise"),
        ("--env.rounds", "5", "give --rounds"),
        ("--env.observation.spin-expected", "strong", "give --spin-expected"),
        ("--env.control-rate-hz", "200", NOBODY),
        ("--env.observation.history", "4", NOBODY),
        ("--env.foresee", "0.5", NOBODY),
        ("--env.reward.heading", "0", NOBODY),
        ("--network.units", "8", NOBODY),
    ],
)
def test_a_policys_exam_refuses_flags_that_would_set_nothing(flag, value, instead):
    with pytest.raises(ConfigError, match=f"^{flag} can't be set here: {instead}$"):
        settings(["--policy", "p", flag, value])
    settings([flag, value])  # a run that is followed may have any


def test_a_policys_exam_takes_what_is_the_exams():
    config = settings(["--policy=p", "--env.collision", "original", "--env.perception", "full"])

    assert (config.env.collision, config.env.perception) == ("original", "full")


def test_a_film_refuses_them_too_and_its_help_keeps_quiet_about_them():
    with pytest.raises(ConfigError, match=f"^--env.observation.spin-expected can't be set here: {NOBODY}$"):
        play.main(["--env.observation.spin-expected", "strong"], Event())
    with pytest.raises(HelpRequest) as asked:
        play.main(["--help"], Event())
    assert "--env.collision" in str(asked.value)
    assert "--env.noise" not in str(asked.value)
