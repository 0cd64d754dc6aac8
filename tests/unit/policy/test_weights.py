import itertools
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from common.policy.box import names, policy_folder
from common.policy.config import NetworkConfig
from common.policy.contract import (
    CONTRACT_FILE,
    WEIGHTS_FILE,
    PolicyError,
    contract_hash,
    contract_of,
    training_hash,
)
from common.policy.folder import Policy, load_policy, mean_policy, save_policy
from common.policy.network_pass import NetworkPass
from common.policy.normalizer import Moments
from common.policy.weights import new_network, pack, unpack
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig, TeacherConfig
from common.task.observation import PAPER_OBSERVATION, ObservationConfig

SMALL = NetworkConfig(units=(16, 8))


PAPER_TASK = TaskConfig(observation=PAPER_OBSERVATION)


def make_contract(task=PAPER_TASK, **changes):
    values = {"run": "r", "generation": 1, "version": 2, "stage": 3, "frames": 4}
    return contract_of(task, ExperienceConfig(), SMALL, **(values | changes))


def saved(folder):
    torch.manual_seed(1)
    network = new_network(SMALL, home_action=np.full(7, 0.3, np.float32))
    moments = Moments(np.linspace(-1, 1, 37), np.linspace(0.5, 2, 37), 123_456_789_012)
    save_policy(folder, network, moments, make_contract())
    return network, moments


def test_a_policy_is_loaded_from_its_folder_bit_for_bit(tmp_path):
    network, moments = saved(tmp_path / "latest")

    policy = load_policy(tmp_path / "latest")

    acting = [name for name in network.state_dict() if not name.startswith("value.")]
    for name in acting:
        assert torch.equal(network.state_dict()[name], policy.network.state_dict()[name])
    np.testing.assert_array_equal(policy.moments.mean, moments.mean)
    assert policy.moments.count == moments.count
    assert policy.contract == make_contract()


def test_a_folder_holds_the_policy_and_not_the_critic(tmp_path):
    """So a policy stays readable when the critic's observation changes."""
    options = ObservationConfig(history=2)
    network = new_network(SMALL, options)
    moments = Moments(np.zeros(90), np.ones(90), 5)
    contract = make_contract(TaskConfig(observation=options))
    save_policy(tmp_path / "p", network, moments, contract)

    policy = load_policy(tmp_path / "p")
    tensors = load_file(tmp_path / "p" / WEIGHTS_FILE)
    obs = np.random.default_rng(0).normal(size=(3, 90)).astype(np.float32)

    assert not any(name.startswith(("value", "critic")) for name in tensors)
    assert policy.moments.mean.shape == (37 + 3 + 13 + 1 + 2 * 6,)
    np.testing.assert_array_equal(policy.act(obs), Policy(network, moments, contract).act(obs))


def test_a_policy_folder_holds_two_plain_files(tmp_path):
    for _ in range(3):
        saved(tmp_path / "latest")

    assert not (tmp_path / "latest").is_symlink()
    assert {path.name for path in (tmp_path / "latest").iterdir()} == {WEIGHTS_FILE, CONTRACT_FILE}
    assert [path.name for path in tmp_path.iterdir()] == ["latest"]


def test_a_policy_folder_of_an_earlier_release_that_is_a_link_becomes_plain(tmp_path):
    saved(tmp_path / ".latest-1")
    (tmp_path / ".latest-0").mkdir()
    (tmp_path / "latest").symlink_to(".latest-1")
    saved(tmp_path / "latest")

    assert not (tmp_path / "latest").is_symlink()
    assert [path.name for path in tmp_path.iterdir()] == ["latest"]
    assert load_policy(tmp_path / "latest").contract.version == 2


def test_a_reader_gets_one_of_the_policies_while_a_writer_replaces_them(tmp_path):
    network, moments = saved(tmp_path / "p")
    writer = os.fork()
    if writer == 0:
        for version in itertools.count(3):
            for name, parameter in network.named_parameters():
                if name.startswith("mean."):
                    parameter.data.fill_(version)
            save_policy(tmp_path / "p", network, moments, make_contract(version=version))
    try:
        seen = set()
        while len(seen) < 10:
            policy = load_policy(tmp_path / "p")
            if policy.contract.version > 2:
                assert torch.all(policy.network.state_dict()["mean.bias"] == policy.contract.version)
                seen.add(policy.contract.version)
    finally:
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)


def test_a_contract_that_was_edited_counts(tmp_path):
    saved(tmp_path / "p")
    edit(tmp_path / "p", "run", "mine")

    assert load_policy(tmp_path / "p").contract.run == "mine"


def test_the_mean_of_policies_has_the_mean_of_their_weights_and_lists_them():
    def policy(seed, task=PAPER_TASK, **changes):
        torch.manual_seed(seed)
        moments = Moments(np.full(37, float(seed)), np.full(37, 1.0 + seed), 9)
        return Policy(new_network(SMALL), moments, make_contract(task, **changes))

    one, other = (
        policy(1, frames=10),
        policy(3, PAPER_TASK.model_copy(update={"launch": "strong"}), frames=30),
    )
    before = {name: value.clone() for name, value in one.network.state_dict().items()}
    mean = mean_policy([one, other])

    for name, value in mean.network.state_dict().items():
        wanted = 0.5 * (before[name] + other.network.state_dict()[name])
        torch.testing.assert_close(value, wanted)
        assert torch.equal(one.network.state_dict()[name], before[name])
    np.testing.assert_allclose(mean.moments.mean, 2.0)
    np.testing.assert_allclose(mean.moments.var, 3.0)
    assert mean.contract.frames == 30
    assert mean.contract.made_with["mean_of"] == "r 10 frames, launch paper; r 30 frames, launch strong"
    obs = np.random.default_rng(0).normal(size=(4, 37)).astype(np.float32)
    np.testing.assert_allclose(mean_policy([one, one]).act(obs), one.act(obs), atol=1e-6)


def test_policies_of_different_shape_have_no_mean():
    fast = PAPER_TASK.model_copy(update={"control_rate_hz": 200})
    one = Policy(new_network(SMALL), Moments.initial(37), make_contract())
    other = Policy(new_network(SMALL), Moments.initial(37), make_contract(fast))

    with pytest.raises(PolicyError, match=r"differ in control_rate_hz: 50 and 200"):
        mean_policy([one, other])


def test_weights_travel_as_bytes_and_arrive_unchanged():
    one, other = new_network(SMALL), new_network(SMALL)

    unpack(other, pack(one))

    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name])


def test_bfloat16_matrices_are_half_as_large_and_act_alike_where_products_are_bfloat16():
    torch.manual_seed(2)
    one, other = new_network(NetworkConfig()), new_network(NetworkConfig())
    obs = torch.randn(64, 37)

    blob = pack(one, "bfloat16")
    unpack(other, blob)

    assert len(blob) < 0.52 * len(pack(one))
    for name, value in one.state_dict().items():
        rounded = value.bfloat16().float() if value.ndim == 2 else value
        assert torch.equal(rounded, other.state_dict()[name])
    means = [NetworkPass(network, 64, "bfloat16").act(obs) for network in (one, other)]
    assert torch.equal(*means)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / WEIGHTS_FILE).unlink(), "no policy in .*No such file.*wanted is a folder"),
        (lambda folder: (folder / WEIGHTS_FILE).write_bytes(b"rubbish"), "not readable as safetensors"),
        (lambda folder: (folder / CONTRACT_FILE).write_text("{"), r"contract.json: file: Invalid JSON"),
        (lambda folder: edit(folder, "run", None), r"contract.json: run: Input should be a valid string"),
        (lambda folder: edit(folder, "task", {"robot": "r2"}), r"contract.json: task.robot: Input should be"),
        (lambda folder: edit(folder, "format", 1), r"contract.json: format: Input should be 2"),
        (lambda folder: edit(folder, "surprise", 1), r"contract.json: surprise: Extra inputs"),
        (lambda folder: edit(folder, "observation", []), "layout is not this version's"),
        (lambda folder: edit(folder, "network", {"units": [16, 9]}), r"shape \(.*\); allowed is"),
        (lambda folder: edit(folder, "network", {"units": [16, 8, 8]}), "weights lack"),
        (lambda folder: edit(folder, "network", {"units": [10**9]}), r"network.units.0: .*got 1000000000"),
        (
            lambda folder: edit(folder, "task", {"control_rate_hz": 33}),
            r"contract.json: task.control_rate_hz: Input should be 25, 50, 100 or 200, got 33",
        ),
        (lambda folder: edit(folder, "stage", 7), "contract.json: stage: .*less than or equal to 3, got 7"),
        (lambda folder: edit(folder, "frames", -1), "contract.json: frames: .*greater than .* got -1"),
        (lambda folder: recoded(folder, "utf-16"), "contract.json is not text in UTF-8: .* at byte 0"),
        (lambda folder: tensor(folder, "obs_moments.var", 3, -1.0), r"obs_moments.var\[3\] is -1.0; allowed"),
        (
            lambda folder: tensor(folder, "obs_moments.var", 0, np.inf),
            r"obs_moments.var\[0\] is inf; allowed",
        ),
        (
            lambda folder: tensor(folder, "obs_moments.var", 0, np.nan),
            r"obs_moments.var\[0\] is nan; allowed",
        ),
        (
            lambda folder: tensor(folder, "obs_moments.mean", 1, np.nan),
            r"weights.safetensors: obs_moments.mean\[1\] is nan; allowed are finite numbers",
        ),
        (
            lambda folder: tensor(folder, "obs_moments.count", ..., [1, 2]),
            r"obs_moments.count is \[1, 2\]; allowed is one",
        ),
        (lambda folder: tensor(folder, "obs_moments.count", ..., 0), r"obs_moments.count is 0; allowed"),
        (lambda folder: tensor(folder, "obs_moments.count", ..., 1.5), r"obs_moments.count is 1.5; allowed"),
        (
            lambda folder: tensor(folder, "mean.bias", 0, np.nan),
            r"safetensors: weights 'mean.bias' are not fin",
        ),
        (lambda folder: tensor(folder, "mean.bias", ..., np.arange(7)), r"'mean.bias' are int64; allowed"),
        (lambda folder: tensor(folder, "mean.bias", ..., np.full(7, 1e300)), r"'mean.bias' are not finite"),
    ],
)
def test_an_unusable_policy_is_refused_with_one_line_that_says_why(tmp_path, damage, message):
    saved(tmp_path / "p")
    damage(tmp_path / "p")

    with pytest.raises(PolicyError, match=message) as caught:
        load_policy(tmp_path / "p")

    assert "\n" not in str(caught.value)


def edit(folder, key, value):
    contract = json.loads((folder / CONTRACT_FILE).read_text())
    (folder / CONTRACT_FILE).write_text(json.dumps(contract | {key: value}))


def recoded(folder, encoding):
    text = (folder / CONTRACT_FILE).read_text(encoding="utf-8")
    (folder / CONTRACT_FILE).write_text(text, encoding=encoding)


def tensor(folder, name, where, value):
    """Change a tensor, or replace it where ``where`` is all of it."""
    tensors = {key: array.copy() for key, array in load_file(folder / WEIGHTS_FILE).items()}
    if where is ...:
        tensors[name] = np.asarray(value)
    else:
        tensors[name][where] = value
    save_file(tensors, folder / WEIGHTS_FILE)


def test_a_contract_with_a_byte_order_mark_is_read(tmp_path):
    saved(tmp_path / "p")
    recoded(tmp_path / "p", "utf-8-sig")

    assert load_policy(tmp_path / "p").contract == make_contract()


def test_the_texts_of_a_layout_may_change(tmp_path):
    saved(tmp_path / "p")
    folder = tmp_path / "p"
    contract = json.loads((folder / CONTRACT_FILE).read_text())
    contract["observation"][0]["meaning"] = "other words"
    (folder / CONTRACT_FILE).write_text(json.dumps(contract))

    assert load_policy(tmp_path / "p").contract.version == 2


def test_any_difference_in_task_or_network_changes_the_contract():
    base = contract_hash(TaskConfig(), SMALL)

    assert contract_hash(TaskConfig(), SMALL) == base
    assert contract_hash(TaskConfig(), NetworkConfig(units=(16, 9))) != base
    assert contract_hash(TaskConfig(randomization="off"), SMALL) != base
    assert contract_hash(TaskConfig(launch="strong"), SMALL) != base


def test_any_difference_in_experience_changes_the_training_hash():
    base = training_hash(TaskConfig(), SMALL, ExperienceConfig())

    assert training_hash(TaskConfig(), SMALL, ExperienceConfig()) == base
    assert training_hash(TaskConfig(launch="strong"), SMALL, ExperienceConfig()) != base
    assert training_hash(TaskConfig(), SMALL, ExperienceConfig(end_at_hit_share=0.5)) != base
    teacher = TeacherConfig(policy="default")
    assert training_hash(TaskConfig(), SMALL, ExperienceConfig(teacher=teacher)) != base


def test_a_policy_of_the_box_is_found_by_its_name_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "default").mkdir()

    assert names() == ["default", "mild", "paper"]
    assert policy_folder("default").resolve() == Path(__file__).parents[3] / "common" / "policies" / "default"
    assert load_policy(policy_folder("default")).contract.task.robot == "rails"
    assert policy_folder("./default").resolve() == tmp_path / "default"
    with pytest.raises(
        PolicyError, match="no policy 'nowhere'; allowed: a policy folder, or one of default, mild, paper"
    ):
        policy_folder("nowhere")
