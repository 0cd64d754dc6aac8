import pytest

from services.learner.budget import Budget


@pytest.mark.parametrize(
    ("trained", "spent"),
    [
        ((999, 599.9), ""),
        ((12_288, 0.0), "12,288 of 10,000 frames"),
        ((0, 600.0), "10 of 10 minutes"),
        ((0, 90_000.0), "1,500 of 10 minutes"),
    ],
)
def test_the_limit_that_is_reached_is_named(trained, spent):
    assert Budget(curriculum=20_000, frames=10_000, minutes=10.0).spent(*trained) == spent


def test_a_limit_of_0_is_no_limit_but_a_curriculum_ends():
    assert Budget(curriculum=100, frames=0, minutes=0.0).spent(99, 1e9) == ""
    assert (
        Budget(curriculum=100, frames=0, minutes=0.0).spent(128, 0.0) == "128 of 100 frames of the curriculum"
    )
    assert Budget(curriculum=0, frames=0, minutes=0.0).spent(0, 0.0) == "0 of 0 frames of the curriculum"
    assert Budget(curriculum=None, frames=0, minutes=0.0).spent(10**9, 1e9) == ""


def test_minutes_count_as_spent_within_the_slack():
    assert (
        Budget(curriculum=100, frames=0, minutes=10.0).spent(50, 599.6, slack_s=1.0) == "9.99 of 10 minutes"
    )
