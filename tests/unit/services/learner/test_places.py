import tomllib

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from common.service.config import load
from common.service.settings import from_learner
from services.actor.config import ActorConfig
from services.learner.config import LearnerConfig
from services.learner.places import HELD_S, MOST_HELD, Places, settings_for_actors


def test_actors_get_the_lowest_free_numbers():
    places = Places()
    assert [places.give("", set(), 0.0) for _ in range(3)] == [("0", 0), ("1", 1), ("2", 2)]
    assert places.give("", {"0", "1", "2", "4"}, 1.0) == ("3", 3)


def test_the_number_of_an_actor_that_has_gone_is_given_again():
    places = Places()
    places.give("", set(), 0.0)
    assert places.give("", {"0"}, HELD_S + 1.0) == ("1", 1)
    assert places.give("", {"1"}, 2.0 * HELD_S + 2.0) == ("0", 0)


def test_a_number_that_nobody_took_is_free_again():
    places = Places()
    places.give("", set(), 0.0)
    assert places.give("", set(), HELD_S - 1.0) == ("1", 1)
    assert places.give("", set(), HELD_S + 1.0) == ("0", 0)


def test_a_number_that_a_named_actor_has_is_not_given():
    places = Places()
    assert places.give("", {"gpu-0", "desk", "rack-2"}, 0.0) == ("1", 1)


def test_a_name_of_a_certificate_has_its_own_number():
    places = Places()
    assert places.give("7", {"0"}, 0.0) == ("7", 7)
    assert places.give("rack-3", set(), 0.0) == ("rack-3", 3)
    assert places.give("desk", set(), 0.0) == ("desk", 0)


def test_a_name_without_a_number_keeps_the_one_that_it_was_given_while_its_actor_lives():
    places = Places()
    assert places.give("gpu-box", set(), 0.0) == ("gpu-box", 0)
    assert places.give("", {"gpu-box"}, 2.0 * HELD_S) == ("1", 1)
    assert places.give("gpu-box", {"1"}, 4.0 * HELD_S) == ("gpu-box", 0)  # it has gone, and comes again


def test_the_numbers_of_a_checkpoints_actors_are_held_until_their_tokens_can_have_come():
    places = Places(["0", "gpu-2", "desk"], now=100.0)
    assert [places.give("", set(), 101.0) for _ in range(2)] == [("1", 1), ("3", 3)]
    assert places.give("gpu-2", set(), 102.0) == ("gpu-2", 2)
    assert places.give("", {"1", "3", "gpu-2"}, 100.0 + HELD_S + 1.0) == ("0", 0)


def test_two_names_with_one_number_get_two(caplog):
    places = Places()
    assert places.give("east-0", set(), 0.0) == ("east-0", 0)
    assert places.give("", set(), 1.0) == ("1", 1)  # east-0 is still starting
    assert places.give("west-0", {"east-0"}, 2.0) == ("west-0", 2)
    assert "actor=west-0 gets the number 2: another actor has 0" in caplog.text
    assert places.give("east-0", {"east-0", "1", "west-0"}, 3.0) == ("east-0", 0)  # the same again


def test_no_name_is_given_twice():
    places = Places()
    assert places.give("x-2", set(), 0.0)[1] == 2
    assert places.give("2", {"x-2"}, 1.0) == ("2", 0)
    present = {"2", "1"}  # x-2 has gone: its number is free, but not the name 2
    assert places.give("", present, 2.0 * HELD_S) == ("3", 3)


def test_a_flood_of_requests_costs_no_memory():
    places = Places()
    given = [places.give("", set(), 0.0)[1] for _ in range(MOST_HELD + 5)]
    assert given[-5:] == [0, 1, 2, 3, 4]
    assert max(given) == MOST_HELD - 1


@given(st.lists(st.sampled_from(["", "a", "b", "east-0", "west-0", "3", "x-3", "2"]), max_size=12))
def test_whatever_their_names_no_two_actors_have_one_number(names):
    places, living = Places(), {}
    for now, wish in enumerate(names):
        name, number = places.give(wish, set(living), now * HELD_S)
        assert name not in living or living[name] == number
        living[name] = number
    assert len(set(living.values())) == len(living)


@given(st.sets(st.integers(0, 30)), st.integers(1, 20))
def test_no_two_actors_that_live_have_one_number(present, joining):
    places, living = Places(), {str(number) for number in present}
    for _ in range(joining):
        name, number = places.give("", living, 0.0)
        assert name not in living
        assert name == str(number)
        living.add(name)


def test_an_actor_gets_the_settings_that_must_be_the_learners(tmp_path):
    file = tmp_path / "config.toml"
    file.write_text('[actor]\nenvs = 48\nhistory = "/somewhere"\n[actor.outbox]\nwindow = 1\n')
    flags = ["--task.launch", "strong", "--network.units", "8,8", "--actors", "5", "--seed", "9"]
    learner = load(LearnerConfig, flags, prog="learner", section="learner", environ={})
    given = settings_for_actors(learner, file)

    text = tomli_w.dumps(given)
    recorded = tmp_path / "given.toml"
    recorded.write_text(text)
    actor = load(ActorConfig, [], prog="actor", section="actor", environ={}, recorded=recorded)
    assert (actor.task, actor.network, actor.experience) == (
        learner.task,
        learner.network,
        learner.experience,
    )
    assert (actor.actors, actor.seed, actor.envs) == (5, 9, 48)
    assert actor.history == ""
    assert tomllib.loads(text) == given


@pytest.mark.parametrize("name", ["endpoint", "tls", "peers", "metrics_host", "log_level", "run"])
def test_no_stranger_says_where_an_actor_connects_or_writes(name):
    assert from_learner({name: "x", "actor": {"history": "/x"}, "learner": {"folder": "/x"}}) == {}
