"""The sliders' ball: what it is, and why it may not be served."""

from dataclasses import replace

import numpy as np
import pytest

from common.evaluation.rally_recorder import record_rallies
from common.task.config import TaskConfig
from common.task.launch import KIND, draw_rallies
from common.task.launch_presets import Kind
from tests.unit.topspin.render.recorded import NEAR_HOME, wave
from topspin.render.replay import spin_word
from topspin.view.ball import SLIDERS, START, ServedBall, ball_of, judge

TASK = TaskConfig(randomization="off")


def launch_of(ball):
    block = judge(ball, TASK, seed=1).block
    assert block is not None
    launch = block.launches[0]
    return launch[:3], launch[3:6], launch[6:9]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "valid: a ball of a rally"),
        ({"speed": 5.0, "elevation": -12.0}, "valid: a serve"),
        ({"elevation": 5.0, "speed": 6.0}, "not valid: it touches the net"),
        ({"speed": 2.0}, "not valid: it bounces twice on its own court"),
        ({"speed": 25.0, "elevation": 30.0}, "not valid: it misses the table"),
        ({"speed": 3.0, "azimuth": 35.0, "y": 0.8}, "not valid: it misses the table"),
        ({"z": -0.01}, "not valid: it starts inside the table"),
    ],
)
def test_a_ball_is_judged_by_the_rule_of_rallies_with_a_reason(changes, text):
    judged = judge(replace(START, **changes), TASK, seed=1)

    assert judged.text == text
    assert (judged.block is None) == text.startswith("not valid")


def test_a_serve_is_launched_as_one():
    serve = judge(replace(START, speed=5.0, elevation=-12.0), TASK, seed=1).block

    assert serve.launches[0, KIND] == Kind.SERVE


@pytest.mark.parametrize("launch", ["paper", "serve"])
def test_balls_that_are_drawn_are_valid_here_too(launch):
    task = TASK.model_copy(update={"launch": launch})
    drawn = draw_rallies(60, task, seed=5)

    valid = [judge(ball_of(row[:3], row[3:6], row[6:9]), task, seed=1).block for row in drawn.launches]

    # the sliders' steps move a ball by up to 5 mm and a quarter of a degree: near the net and the edges that decides
    assert sum(block is not None for block in valid) >= 54


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"topspin": 150.0}, "topspin"),
        ({"topspin": -150.0}, "backspin"),
        ({"topspin": 10.0, "sidespin": 150.0}, "sidespin"),
        ({"topspin": 10.0, "corkscrew": 150.0}, "corkscrew"),
    ],
)
def test_spin_is_what_its_slider_says(changes, word):
    _, vel, spin = launch_of(replace(START, azimuth=4.0, **changes))

    assert spin_word(vel, spin) == word
    assert np.linalg.norm(spin) == pytest.approx(150.0, rel=0.02)


def test_a_copied_ball_is_the_ball():
    ball = ServedBall(7.0, 8.0, -6.0, 120.0, -45.0, 30.0, 1.3, 0.21, 0.33)

    assert ball_of(*launch_of(ball)) == ball
    assert ball_of(np.array([9.0, 0.0, 0.2]), np.array([-99.0, 0.0, 0.0]), np.zeros(3)).x == SLIDERS["x"].high


def test_the_ball_that_is_asked_for_is_the_one_that_is_played():
    ball = judge(replace(START, azimuth=5.0, y=-0.2), NEAR_HOME, seed=7).block

    rally = record_rallies(wave, ball, NEAR_HOME)[0]

    np.testing.assert_array_equal(rally.ball_pos[0], [1.3, -0.2, 0.3])
    assert np.linalg.norm(rally.ball_vel[0]) == pytest.approx(START.speed)
    assert {0, 1} <= set(rally.state)  # it comes, and bounces
