"""`topspin export`: the folder, its mistakes, and what other tools read of it."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import onnx
import pytest
import yaml

from common.env.robot import RobotBatch
from common.errors import ReportedError
from common.policy.box import policy_folder
from common.policy.folder import load_policy
from common.task.observation import policy_layout, size
from tests.unit.topspin.export.exports import ROOT, export, small_policy
from topspin.export import command
from topspin.export.model_card import exam_rows
from topspin.robot.contract import read_contract
from topspin.robot.network import Network


def drawn(policy, count):
    """Return observations like those of the training, and more spread."""
    width = size(policy_layout(policy.contract.task.observation))
    moments, rng = policy.moments.first(width), np.random.default_rng(3)
    return (moments.mean + 1.5 * np.sqrt(moments.var) * rng.normal(size=(count, width))).astype(np.float32)


@pytest.mark.parametrize("name", ["default", "paper"])
def test_the_exported_network_acts_as_a_policy_of_the_box(name, tmp_path):
    policy = load_policy(policy_folder(name))
    export(policy, tmp_path / "out", name)

    contract = read_contract(tmp_path / "out")
    obs = drawn(policy, 300)
    actions = Network(tmp_path / "out" / "policy.onnx", contract.size).act(obs)

    np.testing.assert_allclose(actions, np.clip(policy.act(obs), -1.0, 1.0), atol=1e-5)
    assert np.abs(policy.act(obs)).max() > 1.0  # the limits were met


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small policy of the paper's observation, and the folder that it is exported to."""
    policy, out = small_policy(), tmp_path_factory.mktemp("small") / "out"
    export(policy, out, "small")
    return policy, out


def test_the_contract_has_the_environments_joint_mapping_and_limits(small):
    policy, out = small
    contract, robot = read_contract(out), RobotBatch(1, policy.contract.task.robot)

    for field, theirs in [
        ("middle", robot.middle),
        ("half_range", robot.half_range),
        ("home", robot.home),
        ("speed", robot.speed_limit),
        ("force", robot.torque_limit),
    ]:
        np.testing.assert_array_equal(contract.of_joints(field), theirs)
    for ours, theirs in zip(contract.kinematics.chain(), robot.chain, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert contract.joint_names == [joint.name for joint in robot.description.joint]
    assert contract.control_rate_hz == policy.contract.task.control_rate_hz
    assert contract.filters.observed_ago == pytest.approx(0.025)


def test_the_second_output_is_the_joint_targets(small):
    import onnxruntime

    policy, out = small
    contract, obs = read_contract(out), drawn(policy, 20)
    session = onnxruntime.InferenceSession(str(out / "policy.onnx"), providers=["CPUExecutionProvider"])
    actions, targets = session.run(["actions", "joint_targets"], {"obs": obs})

    middle, half_range = contract.of_joints("middle"), contract.of_joints("half_range")
    np.testing.assert_allclose(targets, middle + half_range * actions, atol=1e-6)


def test_the_file_alone_says_what_goes_in_and_out(small):
    _, out = small
    model = onnx.load(out / "policy.onnx")
    said = {prop.key: prop.value for prop in model.metadata_props}

    assert said["joint_names"] == "rail_x,rail_y,yaw,pitch,elbow,wrist,roll"
    assert said["action_scale"].split(",")[:2] == ["0.75", "0.9"]
    assert sum(map(int, said["observation_sizes"].split(","))) == 37
    assert [opset.version for opset in model.opset_import] == [17]


def test_the_card_has_metadata_and_every_measured_figure(tmp_path):
    policy = load_policy(policy_folder("mild"))
    contract, parity = export(policy, tmp_path / "out", "mild")
    _, matter, text = (tmp_path / "out" / "README.md").read_text().split("---\n", 2)
    metadata = yaml.safe_load(matter)

    assert metadata["pipeline_tag"] == "robotics"
    (index,) = metadata["model-index"]
    assert [r["metrics"][0]["value"] for r in index["results"]] == [
        exam["return_rate"] for exam in policy.contract.measures.values()
    ]
    assert len(exam_rows(contract)) == 3
    # Trained and measured before the air was a condition of an exam: in that of the training
    assert "| paper | 2000 `paper`, 1 in a row | simple | standard | cheap | 92.6%" in text
    assert f"by at most {parity:.1e}" in text
    assert all(joint.name in text for joint in contract.joints)


def test_the_card_of_a_runs_policy_has_what_its_evaluator_measured(tmp_path):
    policy = small_policy()
    measures = {"return_rate": 0.8125, "return_rate_ci": [0.79, 0.83], "target_error_mean": 0.31}
    match = {"match": {"rallies": 1000, "rounds": 1}}
    policy = replace(policy, contract=policy.contract.model_copy(update={"measures": measures | match}))
    contract, _ = export(policy, tmp_path / "out", "mine")

    (row,) = exam_rows(contract)
    assert (row["exam"], row["balls"], row["return_rate"]) == (
        "in its run",
        "1000 `paper`, 1 in a row",
        0.8125,
    )
    assert "| in its run | 1000 `paper`, 1 in a row |" in (tmp_path / "out" / "README.md").read_text()


def test_the_card_of_a_policy_without_measures_says_so(small):
    _, out = small

    assert "This policy has not been measured." in (out / "README.md").read_text()
    assert "model-index" not in (out / "README.md").read_text()


def test_leapp_runs_the_exported_pipeline(small):
    policy, out = small
    obs = drawn(policy, 1)
    program = (
        "import sys, json, torch; from leapp import InferenceManager\n"
        "pipeline = InferenceManager(sys.argv[1])\n"
        "found = pipeline.run_policy({'policy/obs': torch.tensor(json.loads(sys.argv[2]))})\n"
        "print(json.dumps({'inputs': pipeline.inputs, 'targets': found['policy/joint_targets'].tolist()}))\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program, str(out / "leapp.yaml"), json.dumps(obs.tolist())],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])

    contract = read_contract(out)
    ours = contract.of_joints("middle") + contract.of_joints("half_range") * np.clip(policy.act(obs), -1, 1)
    assert found["inputs"] == ["policy/obs"]
    np.testing.assert_allclose(found["targets"], ours, atol=1e-5)


def test_the_command_says_what_it_wrote(small, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    from common.policy.folder import save_policy

    policy, _ = small
    save_policy(
        tmp_path / "runs" / "night" / "policy" / "latest", policy.network, policy.moments, policy.contract
    )
    command.main(["--policy", "runs/night/policy/latest", "--out", "mine", "--json"], Event())

    said = json.loads(capsys.readouterr().out)
    assert said["policy"] == policy.contract.run  # `latest` is no name
    assert said["parity_max"] <= 1e-5
    assert said["files"] == sorted(os.listdir("mine"))
    assert [name for name in os.listdir() if name.startswith(".")] == []


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (
            ["--policy", "nowhere"],
            r"no policy 'nowhere'; allowed: a policy folder, or one of default, mild, paper",
        ),
        (["--out", "full"], "full is not empty; allowed: a new or an empty folder"),
        (
            ["--out", "."],
            r"\. is the current folder, which can't be replaced; allowed: another one \(--out\)",
        ),
        (["--out", "file"], "file is no folder; allowed: a new or an empty folder"),
        (["--out", "file/in"], "can't write beside file/in"),
        (["--out", "a", "--web", "b"], "--out a and --web b; allowed: one of them"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(flags, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thing").touch()
    (tmp_path / "file").touch()

    with pytest.raises(ReportedError, match=line):
        command.main(flags, Event())

    assert sorted(os.listdir()) == ["file", "full"]


def test_a_policy_that_no_robot_can_play_with_is_refused(tmp_path):
    with pytest.raises(ReportedError, match="observes the true spin; allowed"):
        export(small_policy(spin="true"), tmp_path / "out", "cheat")
    assert not list(tmp_path.iterdir())


def test_without_the_extra_an_export_says_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    for module in ("onnx_graph", "model_card", "leapp"):
        monkeypatch.delitem(sys.modules, f"topspin.export.{module}", raising=False)

    with pytest.raises(ReportedError, match=re.escape("pip install -e '.[export]'")):
        export(small_policy(), tmp_path / "out", "small")
    assert not list(tmp_path.iterdir())


def test_the_readme_prints_the_example_that_is_tested():
    (snippet,) = [
        block
        for block in re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
        if "topspin_robot" in block
    ]

    assert snippet == Path(ROOT / "topspin" / "export" / "example.py").read_text()
