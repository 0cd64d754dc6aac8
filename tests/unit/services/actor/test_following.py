from services.actor.following import Following, adopted, noted, objection

OLD, NEW, FORGED = 7, 3, 2**62


def test_a_learner_counts_while_its_token_stands():
    alone = Following()
    led = noted(alone, OLD, True)

    assert objection(alone, OLD) == "generation 7 has no live learner"
    assert objection(led, OLD) == ""
    assert objection(noted(led, OLD, False), OLD) != ""


def test_a_higher_number_wins_nothing_while_the_followed_learner_lives():
    following = adopted(noted(Following(), OLD, True), OLD)

    assert objection(following, FORGED) == f"generation {FORGED} has no live learner"
    assert "the followed learner, 7, which lives" in objection(noted(following, FORGED, True), FORGED)


def test_the_next_learner_is_followed_whatever_its_number():
    following = adopted(noted(Following(), OLD, True), OLD)
    following = noted(noted(following, OLD, False), NEW, True)

    assert objection(following, NEW) == ""
    assert objection(following, OLD) != ""
    assert not following.is_led
    assert adopted(following, NEW).is_led
