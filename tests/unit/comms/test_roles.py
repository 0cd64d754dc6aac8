"""The table of roles: who may say what, in plain words."""

import pytest

from common.comms.keys import ROLES as SERVICES
from common.comms.keys import KeyPartError, Keys, matches
from common.comms.roles import OPERATOR, ROLES, access_control, rights_of

KEYS = Keys("r")


def who(verb, key, id_="3"):
    """Return the roles that may do this, each with this id."""
    rights = {role: getattr(rights_of(f"{role}-{id_}", KEYS), verb) for role in ROLES}
    return {role for role, expressions in rights.items() if any(matches(e, key) for e in expressions)}


def test_every_service_has_a_role_and_there_is_an_operator():
    assert set(ROLES) == {*SERVICES, OPERATOR}


@pytest.mark.parametrize(
    ("verb", "key", "roles"),
    [
        ("publish", KEYS.rally(7), {"generator"}),
        ("answer", KEYS.rally(7), {"generator"}),
        ("ask", KEYS.rollout("3"), {"actor"}),
        ("ask", KEYS.rollout("4"), set()),
        ("ask", KEYS.report("3"), {"actor"}),
        ("ask", KEYS.report("4"), set()),
        ("ask", KEYS.rollout("3", rank=2), {"actor"}),
        ("answer", KEYS.rollout("8", rank=3), {"learner"}),
        ("answer", KEYS.rollout("8", rank=0), set()),
        ("answer", KEYS.report("8", rank=3), {"learner"}),
        ("publish", KEYS.status("actor", "3"), {"actor"}),
        ("publish", KEYS.status("actor", "4"), set()),
        ("publish", KEYS.status("learner", "3"), {"learner"}),
        ("subscribe", KEYS.status("actor", "3"), {"operator"}),
        ("ask", KEYS.ctl("learner", "0"), {"operator"}),
        ("ask", KEYS.ctl("actor", "3"), {"operator"}),
        ("answer", KEYS.ctl("actor", "3"), {"actor"}),
        ("answer", KEYS.ctl("actor", "4"), set()),
        ("show", KEYS.alive("actor", "3", 1), {"actor"}),
        ("show", KEYS.alive("actor", "4", 1), set()),
        ("show", KEYS.alive("learner", "3", 1), {"learner"}),
        ("watch", KEYS.alive("learner", "0", 1), {"actor", "learner", "operator"}),
    ],
)
def test_only_these_roles_may(verb, key, roles):
    assert who(verb, key) == roles


@pytest.mark.parametrize("verb", ["publish", "answer"])
@pytest.mark.parametrize("key", [KEYS.policy(), KEYS.stage()])
def test_of_a_group_of_learners_only_the_first_says_what_is_played(verb, key):
    assert who(verb, key, "0") == {"learner"}
    assert who(verb, key, "3") == set()


def test_a_name_without_a_role_is_refused():
    for name, message in (
        ("umpire-0", "unknown role"),
        ("actor", "id '' can't stand"),
        ("actor-a/b", "id 'a/b'"),
    ):
        with pytest.raises(KeyPartError, match=message):
            access_control([name], "r")


def test_whoever_is_not_named_may_nothing():
    rules = access_control(["actor-3", "learner-0"], "r")

    assert rules["default_permission"] == "deny"
    assert [subject["cert_common_names"] for subject in rules["subjects"]] == [["actor-3"], ["learner-0"]]
    assert {rule["permission"] for rule in rules["rules"]} == {"allow"}
