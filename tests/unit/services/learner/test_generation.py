import pytest

from services.learner.generation import HIGHEST, NOISE_BITS, following, next_generation, yields


def test_each_learner_of_a_folder_is_newer_than_all_before_without_a_clock(tmp_path):
    found = [next_generation(tmp_path / "generation", 0) for _ in range(5)]

    assert found == sorted(set(found))
    assert [number >> NOISE_BITS for number in found] == [1, 2, 3, 4, 5]


def test_a_checkpoint_counts_where_the_folders_number_is_missing_or_damaged(tmp_path):
    earlier = 1_760_000_000  # of a release that took the time of day
    (tmp_path / "generation").write_text("nonsense")

    assert next_generation(tmp_path / "generation", earlier) > earlier
    assert next_generation(tmp_path / "generation", 0) > earlier


def test_two_learners_from_copies_of_one_folder_differ():
    assert following(5 << NOISE_BITS, 1) != following(5 << NOISE_BITS, 2)
    assert following(HIGHEST, 1) == HIGHEST


@pytest.mark.parametrize(
    ("own", "other", "age", "ends"), [(1, 2, 0.5, True), (2, 1, 0.5, False), (1, 2, 60.0, False)]
)
def test_of_two_that_start_together_the_lower_ends_and_an_older_one_stays(own, other, age, ends):
    assert yields(own, other, age_s=age, settling_s=6.0) is ends
