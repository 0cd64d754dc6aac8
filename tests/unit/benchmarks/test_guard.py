from benchmarks.guard import slower


def test_a_ratio_below_three_quarters_of_the_recorded_one_is_named():
    assert slower({"env": 0.52, "actor": 0.6}, {"env": 0.7, "actor": 0.6}) == ["env"]


def test_a_ratio_at_three_quarters_or_above_passes():
    assert slower({"env": 0.525, "actor": 0.9}, {"env": 0.7, "actor": 0.6}) == []


def test_a_ratio_that_is_not_a_number_counts_as_fallen():
    assert slower({"env": float("nan")}, {"env": 0.7}) == ["env"]
