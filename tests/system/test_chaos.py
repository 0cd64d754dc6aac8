"""A short run of the chaos benchmark: the long one is `python -m benchmarks.chaos`."""

from tests.system.commands import last_json, run

KINDS = "kill_actor,kill_learner,router_kill,disk_full,hung_reader,wrong_contract"


def test_nothing_is_lost_or_trained_twice_in_a_run_that_is_broken_on_purpose(tmp_path):
    flags = ("--faults", 6, "--seed", 5, "--kinds", KINDS, "--json")
    status, out, err = run(tmp_path, "benchmarks.chaos", *flags, timeout_s=240)

    assert status == 0, err
    found = last_json(out)
    assert found["violations"] == 0, err
    assert found["unaccounted"] == found["trained_twice"] == 0
    assert found["faults"] >= 5  # without privileges no disk is filled
    assert found["trained"] > 0
