"""A policy in the box: measured on every exam, readable, and the same policy."""

import json
from threading import Event

import numpy as np
import pytest

from common.policy.weights import PolicyError, load_policy
from services.evaluator import ship
from tests.unit.evaluator.test_match import make_policy


@pytest.fixture
def box(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def put_policy(folder):
    from common.policy.weights import write_policy

    policy = make_policy()
    write_policy(folder, policy.network, policy.moments, policy.contract)
    return policy


def test_a_shipped_policy_is_measured_on_every_exam_and_plays_as_it_did(box, capsys):
    policy = put_policy(box / "trained")

    ship.main(["--policy", "trained", "--name", "mine", "--rallies", "12"], Event())

    shipped = load_policy(box / "assets" / "policies" / "mine")
    said = json.loads(capsys.readouterr().out)
    assert set(shipped.contract.measures) == set(ship.EXAMS)
    assert said["measures"] == shipped.contract.measures
    for name, what in ship.EXAMS.items():
        exam = shipped.contract.measures[name]
        assert (exam["rallies"], exam["launch"], exam["rounds"]) == (12, what["launch"], what["rounds"])
        assert exam["noise"] == "standard"
    assert shipped.contract.made_with["commit"]
    obs = np.random.default_rng(0).normal(size=(5, policy.moments.mean.size)).astype(np.float32)
    np.testing.assert_array_equal(shipped.act(obs), policy.act(obs))
    assert not list((box / "assets" / "policies").glob(".*"))


def test_it_can_be_shipped_with_other_spins_expected_and_is_measured_so(box):
    trained = put_policy(box / "trained")

    ship.main(
        ["--policy", "trained", "--name", "mine", "--rallies", "4", "--spin-expected", "learnt"], Event()
    )

    contract = load_policy(box / "assets" / "policies" / "mine").contract
    assert contract.observation_options.spin_expected == "learnt"
    assert {exam["spin_expected"] for exam in contract.measures.values()} == {"learnt"}
    assert contract.env == trained.contract.env  # what it was trained with stays


def test_of_several_policies_the_mean_is_shipped(box):
    one, other = put_policy(box / "one"), put_policy(box / "other")

    ship.main(["--policy", "one,other", "--name", "mine", "--rallies", "4"], Event())

    shipped = load_policy(box / "assets" / "policies" / "mine")
    parts = [policy.network.state_dict()["mean.weight"].numpy() for policy in (one, other)]
    np.testing.assert_allclose(
        shipped.network.state_dict()["mean.weight"].numpy(), np.mean(parts, axis=0), atol=1e-7
    )
    assert shipped.contract.made_with["mean_of"].count("frames") == 2


def test_what_is_no_policy_is_not_shipped(box):
    with pytest.raises(PolicyError, match="no policy in"):
        ship.main(["--policy", "nowhere", "--rallies", "5"], Event())

    assert not (box / "assets").exists()
