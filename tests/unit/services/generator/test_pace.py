import pytest

from services.generator.pace import Pace, shards_of


@pytest.mark.parametrize("of", [1, 2, 3, 7])
@pytest.mark.parametrize("shards", [1, 2, 5, 7])
def test_every_shard_has_a_generator_and_only_one_unless_there_are_too_many(of, shards):
    filled = [shard for index in range(of) for shard in shards_of(index, of, shards)]

    assert set(filled) == set(range(shards))
    assert len(filled) == max(of, shards)


def test_an_index_beyond_the_generators_is_refused():
    with pytest.raises(ValueError, match="generator index 3; allowed are 0 to 2"):
        shards_of(3, 3, 8)


def sent(pace, times):
    return sum(pace.due(now) for now in times)


def test_batches_are_due_at_the_rate():
    pace = Pace(rate_hz=100.0, batch=50)

    assert sent(pace, [i / 100 for i in range(1000)]) == 20  # two per second over ten seconds


def test_a_stall_is_not_followed_by_a_burst():
    pace = Pace(rate_hz=100.0, batch=50)
    pace.due(0.0)

    assert sent(pace, [60.0, 60.0, 60.0, 60.1]) <= 2


def test_the_first_subscriber_after_idleness_gets_a_batch_at_once():
    pace = Pace(rate_hz=1.0, batch=100)
    assert pace.due(0.0)
    assert pace.wait(0.0) == 100.0

    pace.idle(5.0)

    assert pace.due(5.0)
    assert not pace.due(5.1)
