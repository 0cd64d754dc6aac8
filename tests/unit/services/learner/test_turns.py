from hypothesis import given
from hypothesis import strategies as st

from services.learner.turns import Rank, parts, taken

RANKS = st.lists(
    st.builds(
        lambda queued, able, idle: Rank(queued, able, max(able - idle, 0), 0),
        st.integers(0, 9),
        st.integers(0, 6),
        st.integers(0, 6),
    ),
    min_size=1,
    max_size=5,
)


def rank(queued=0, able=1, active=1):
    return Rank(queued, able, active, 0)


def test_an_update_waits_for_a_whole_dataset_over_all_ranks():
    assert taken([rank(2), rank(1)], 4) == (0, 0)
    assert taken([rank(2), rank(2)], 4) == (2, 2)


def test_the_work_is_divided_evenly_where_the_rollouts_allow_it():
    assert taken([rank(4), rank(4)], 4) == (2, 2)
    assert taken([rank(7), rank(1)], 4) == (3, 1)
    assert taken([rank(4), rank(0)], 4) == (4, 0)


def test_a_rank_asks_for_as_much_as_its_share_of_the_actors():
    assert parts([rank(able=2, active=2), rank(able=1, active=1)], 6) == (4, 2)
    assert parts([rank(able=3, active=3), rank(able=0, active=0)], 6) == (6, 0)


def test_actors_that_hang_hold_nobody_up_and_may_come_back():
    assert parts([rank(able=2, active=2), rank(able=1, active=0)], 4) == (4, 1)


def test_at_the_start_nobody_has_brought_anything():
    assert parts([rank(able=0, active=0), rank(able=1, active=0)], 3) == (2, 2)


@given(RANKS, st.integers(1, 12))
def test_a_dataset_has_its_size_and_no_rank_gives_more_than_it_has(ranks, dataset):
    counts = taken(ranks, dataset)
    waiting = sum(one.queued for one in ranks)
    assert sum(counts) == (dataset if waiting >= dataset else 0)
    assert all(0 <= count <= one.queued for count, one in zip(counts, ranks, strict=True))


@given(RANKS, st.integers(1, 12))
def test_what_the_ranks_ask_for_makes_a_whole_dataset(ranks, dataset):
    asked = parts(ranks, dataset)
    assert sum(asked) >= dataset
    assert all(part > 0 for part, one in zip(asked, ranks, strict=True) if one.able)
