"""A released policy: measured on every exam, readable, and unchanged."""

import json
from dataclasses import replace
from threading import Event

import numpy as np
import pytest

from common.errors import ConfigError
from common.policy.contract import PolicyError
from common.policy.folder import load_policy, mean_policy, save_policy
from tests.unit.evaluation.test_match import make_policy
from topspin import release


@pytest.fixture
def box(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def one_exam(monkeypatch):
    """Measure on one exam: that all are taken is another test's."""
    monkeypatch.setattr(release, "EXAMS", {"paper": release.EXAMS["paper"]})


def put_policy(folder):
    policy = make_policy()
    save_policy(folder, policy.network, policy.moments, policy.contract)
    return policy


def test_a_released_policy_is_measured_on_every_exam_and_plays_as_before(box, capsys):
    policy = put_policy(box / "trained")

    release.main(["--policy", "trained", "--name", "mine", "--rallies", "12", "--box", "box"], Event())

    released = load_policy(box / "box" / "mine")
    line = json.loads(capsys.readouterr().out)
    assert set(released.contract.measures) == set(release.EXAMS)
    assert line["measures"] == released.contract.measures
    for name, what in release.EXAMS.items():
        exam = released.contract.measures[name]
        assert (exam["rallies"], exam["launch"], exam["rounds"]) == (12, what["launch"], what["rounds"])
        assert exam["randomization"] == "standard"
    assert released.contract.made_with["commit"]
    obs = np.random.default_rng(0).normal(size=(5, policy.moments.mean.size)).astype(np.float32)
    np.testing.assert_array_equal(released.act(obs), policy.act(obs))
    assert not list((box / "box").glob(".*"))


def test_a_policy_can_be_released_with_another_expected_spin_and_is_measured_with_it(box, one_exam):
    trained = put_policy(box / "trained")

    release.main(
        [
            "--policy",
            "trained",
            "--name",
            "mine",
            "--rallies",
            "4",
            "--expected-spin",
            "learnt",
            "--box",
            "box",
        ],
        Event(),
    )

    contract = load_policy(box / "box" / "mine").contract
    assert contract.task.observation.expected_spin == "learnt"
    assert {exam["expected_spin"] for exam in contract.measures.values()} == {"learnt"}
    assert contract.made_with["trained_with_expected_spin"] == trained.contract.task.observation.expected_spin


def test_of_several_policies_the_mean_is_released(box, one_exam):
    one, other = put_policy(box / "one"), put_policy(box / "other")

    release.main(["--policy", "one, other", "--name", "mine", "--rallies", "4", "--box", "box"], Event())

    released = load_policy(box / "box" / "mine")
    parts = [policy.network.state_dict()["mean.weight"].numpy() for policy in (one, other)]
    np.testing.assert_allclose(
        released.network.state_dict()["mean.weight"].numpy(), np.mean(parts, axis=0), atol=1e-7
    )
    assert released.contract.made_with["mean_of"].count("frames") == 2


def test_a_folder_without_a_policy_is_not_released(box):
    with pytest.raises(PolicyError, match="no policy 'nowhere'"):
        release.main(["--policy", "nowhere", "--name", "mine", "--rallies", "5", "--box", "box"], Event())

    assert not (box / "box").exists()


def test_a_name_must_be_given(box):
    with pytest.raises(ConfigError, match="--name must be given; allowed: text, matching"):
        release.main(["--policy", "trained", "--box", "box"], Event())


def test_a_policy_of_the_box_is_replaced_only_on_request(box, one_exam):
    put_policy(box / "trained")
    mine = box / "box" / "mine"
    put_policy(mine)
    before = (mine / "contract.json").read_bytes()
    flags = ["--policy", "trained", "--name", "mine", "--rallies", "4", "--box", "box"]

    with pytest.raises(ConfigError, match=r"box/mine exists; allowed: another --name, or --replace"):
        release.main(flags, Event())
    assert (mine / "contract.json").read_bytes() == before

    assert release.main([*flags, "--replace"], Event()) == 0
    assert load_policy(mine).contract.measures["paper"]["rallies"] == 4


@pytest.mark.parametrize("given", ["one,", ",one", "one, ,other"])
def test_an_empty_name_among_several_policies_is_refused(box, given):
    with pytest.raises(ConfigError, match="has an empty name; allowed: policies, separated by commas"):
        release.main(["--policy", given, "--name", "mine", "--rallies", "4", "--box", "box"], Event())


def test_policies_that_observe_other_quantities_have_no_mean():
    policy = make_policy()
    observation = policy.contract.task.observation
    ball = "filtered" if observation.ball == "sampled" else "sampled"
    task = policy.contract.task.model_copy(
        update={"observation": observation.model_copy(update={"ball": ball})}
    )
    other = replace(policy, contract=policy.contract.model_copy(update={"task": task}))

    with pytest.raises(PolicyError, match="observation"):
        mean_policy([policy, other])
