import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.comms.keys import KeyPartError, Keys, Member, matches, rank_of

KEYS = Keys("night-1")


@pytest.mark.parametrize(
    ("key", "text"),
    [
        (KEYS.policy(), "topspin/v3/night-1/policy"),
        (KEYS.stage(), "topspin/v3/night-1/stage"),
        (KEYS.rollout("0"), "topspin/v3/night-1/rollout/0/0"),
        (KEYS.rollout("7", rank=3), "topspin/v3/night-1/rollout/3/7"),
        (KEYS.report("lab-1"), "topspin/v3/night-1/report/0/lab-1"),
        (KEYS.report("lab-1", rank=1), "topspin/v3/night-1/report/1/lab-1"),
        (KEYS.rally(3), "topspin/v3/night-1/rally/3"),
        (KEYS.ctl("actor", "a-0"), "topspin/v3/night-1/ctl/actor/a-0"),
        (KEYS.alive("actor", "a-0", 12), "topspin/v3/night-1/alive/actor/a-0/12"),
        (KEYS.status("learner", "l"), "topspin/v3/night-1/status/learner/l"),
    ],
)
def test_keys_are_as_documented(key, text):
    assert key == text


def test_actors_that_are_numbered_are_divided_evenly_among_the_learners():
    assert [rank_of(str(number), 3) for number in range(7)] == [0, 1, 2, 0, 1, 2, 0]
    assert [rank_of(f"topspin-actor-{number}", 2) for number in (0, 1, 10, 11)] == [0, 1, 0, 1]
    assert {rank_of(name, 4) for name in ("lab", "7", "x-3", "desk-of-a-person")} <= set(range(4))
    assert rank_of("anything", 1) == 0


@pytest.mark.parametrize("run", ["", "a/b", "*", "a*", "a?", "a#", "$a", "@a", "ä", "a b", ".a", "x" * 65])
def test_a_run_name_that_cannot_be_part_of_a_key_is_refused(run):
    with pytest.raises(KeyPartError, match=r"run .* can't stand in a key; allowed: 1 to 64 letters"):
        Keys(run)


def test_bad_roles_ids_and_numbers_are_refused():
    with pytest.raises(KeyPartError, match="unknown role 'umpire'; allowed: generator, actor"):
        KEYS.status("umpire", "0")
    with pytest.raises(KeyPartError, match=r"id '\*' can't stand in a key"):
        KEYS.ctl("actor", "*")
    with pytest.raises(KeyPartError, match="shard -1"):
        KEYS.rally(-1)


@given(
    st.sampled_from(["generator", "actor", "learner", "evaluator"]),
    st.from_regex(r"\A[a-z0-9]{1,9}\Z"),
    st.integers(0, 2**62),
)
def test_a_liveliness_key_names_its_member(role, id_, incarnation):
    assert KEYS.member(KEYS.alive(role, id_, incarnation)) == Member(role, id_, incarnation)


@pytest.mark.parametrize(
    "key", ["", "topspin/v3/other/alive/actor/a/1", KEYS.policy(), f"{KEYS.alive('actor', 'a', 1)}/x"]
)
def test_a_key_that_is_not_a_liveliness_key_is_refused(key):
    with pytest.raises(KeyPartError, match="is not topspin/v3/night-1/alive/"):
        KEYS.member(key)


@pytest.mark.parametrize(
    ("key_expr", "key", "wanted"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/c", False),
        ("a/*", "a/b", True),
        ("a/*", "a/b/c", False),
        ("a/*", "a", False),
        ("a/**", "a", True),
        ("a/**", "a/b/c", True),
        ("a/**/c", "a/b/b/c", True),
        ("**/c", "a/b", False),
    ],
)
def test_wildcards_stand_for_one_or_for_any_number_of_chunks(key_expr, key, wanted):
    assert matches(key_expr, key) == wanted


def test_the_expressions_for_all_members_match_every_member():
    assert matches(KEYS.every_alive(), KEYS.alive("actor", "a", 1))
    assert matches(KEYS.every_status(), KEYS.status("actor", "a"))
