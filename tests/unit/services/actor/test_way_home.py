import numpy as np

from services.actor.way_home import way_home


def test_the_way_home_is_straight_and_ends_there():
    home = np.linspace(-0.5, 0.5, 7, dtype=np.float32)
    away = np.zeros((3, 7), np.float32)
    away[0, 2], away[1, 5], away[2] = 0.01, -0.8, 0.4
    led = way_home(home + away, home)

    np.testing.assert_allclose(led[0], -away[0], atol=1e-7)  # near home: all the way
    np.testing.assert_allclose(led[1], -away[1] * 0.02 / 0.8, atol=1e-7)
    np.testing.assert_allclose(led[2], np.full(7, -0.02 / np.sqrt(7.0)), rtol=1e-5)
    np.testing.assert_array_equal(way_home(home[None], home), 0.0)
    assert way_home(np.zeros((0, 7), np.float32), home).shape == (0, 7)


def test_a_robot_that_is_led_home_meets_its_next_ball_there():
    """The last correction is 0 at home only: followed again and again, the mean ends there."""
    home = np.zeros(7, np.float32)
    mean = np.full((1, 7), 0.3, np.float32)
    for _ in range(60):
        mean = mean + way_home(mean, home)

    np.testing.assert_allclose(mean, 0.0, atol=1e-6)
