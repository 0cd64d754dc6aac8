"""The controller of a robot: what it observes and does, and what bad measurements do to it."""

import math
import re

import numpy as np
import pytest
from numba.core import event

from benchmarks.export import Controllers, Ours, Trackers, make_env, play
from common.errors import ReportedError
from common.evaluation.match import evaluation_rallies
from common.policy.box import policy_folder
from common.policy.folder import load_policy
from common.rally.observer import BallSample
from tests.unit.topspin.export.exports import export, small_policy
from topspin.robot import Fault, load
from topspin.robot.contract import POLICY_FILE, Kinematics, read_contract
from topspin.robot.controller import MAX_HELD, Controller
from topspin.robot.faults import MAX_AGE
from topspin.robot.made_up_ball import detections
from topspin.robot.network import Network

NAN, INF = math.nan, math.inf
PERIOD = 0.02


@pytest.fixture(scope="module")
def default(tmp_path_factory):
    """The policy `default`, and the folder that it is exported to."""
    policy, out = load_policy(policy_folder("default")), tmp_path_factory.mktemp("default") / "out"
    export(policy, out, "default")
    return policy, out


@pytest.fixture(scope="module")
def parts(default):
    """Contract and network of the exported `default`."""
    contract = read_contract(default[1])
    return contract, Network(default[1] / POLICY_FILE, contract.size)


@pytest.fixture
def controller(parts):
    return Controller(*parts)


def never():
    return False


def task_of(policy, launch):
    return policy.contract.task.model_copy(update={"perception": "full", "launch": launch})


@pytest.mark.parametrize("launch", ["paper", "serve"])
def test_observations_and_actions_are_those_of_the_simulated_robot(default, parts, launch):
    policy, _ = default
    task = task_of(policy, launch)
    rallies = evaluation_rallies(8, task, 5)
    env = make_env(task, rallies, 4)
    trackers = Trackers(env, *parts, policy)
    play(env, trackers, rallies, never)

    assert trackers.compared > 200
    assert trackers.observation_error <= 1e-5
    assert trackers.action_error <= 1e-5


def test_controllers_return_the_balls_that_our_policy_returns(default, parts):
    policy, _ = default
    task = task_of(policy, "paper")
    rallies = evaluation_rallies(16, task, 6)
    ours = play(make_env(task, rallies, 8), Ours(policy), rallies, never)
    env = make_env(task, rallies, 8)
    controllers = Controllers(env, *parts)

    assert play(env, controllers, rallies, never) == ours > 0.5
    assert all(not each.faults for each in controllers.controllers)


def play_ball(controller, steps=12, joints=None, spoil=lambda step, moment, pos: (moment, pos), start=1.0):
    """Return the commands of a made-up ball. ``joints`` gives the joints of a step, ``spoil`` changes detections."""
    home, still = controller.contract.of_joints("home"), np.zeros(7)
    controller.begin((0.9, 0.1))
    pictures, commands = list(detections(steps * PERIOD)), []
    for step in range(steps):
        while pictures and pictures[0][0] <= step * PERIOD:
            moment, pos = spoil(step, *pictures.pop(0))
            controller.see(start + moment, pos)
        pos, vel = joints(step, home.copy(), still.copy()) if joints else (home, still)
        commands.append(controller.step(start + step * PERIOD, pos, vel))
    return commands


def positions(commands):
    return np.array([command.positions for command in commands])


def test_a_loaded_controller_compiles_nothing_more(default):
    controller = load(default[1])
    with event.install_recorder("numba:compile") as compiled:
        commands = play_ball(controller)
        controller.begin((0.9, 0.1), served=True, new_opponent=True)
        controller.see(5.0, (2.0, 0.1, 0.3))
        controller.step(5.0, controller.contract.of_joints("home"), np.zeros(7))
        controller.begin((0.9, 0.1))
        controller.measure(BallSample((1.0, 0.1, 0.3), (-5.0, 0.0, 1.0), 0, 6.0))
        command = controller.step(6.0, controller.contract.of_joints("home"), np.zeros(7))

    assert compiled.buffer == []
    assert all(command.is_new for command in commands)
    assert command.is_new


def test_the_first_ball_is_played_as_any_other(parts):
    first = play_ball(Controller(*parts))
    used = Controller(*parts)
    used.warm_up()
    play_ball(used)

    np.testing.assert_allclose(positions(play_ball(used, start=9.0)), positions(first), atol=1e-6)


def test_a_ball_before_begin_is_counted_and_nothing_follows_it(controller):
    controller.see(0.0, (0.5, 0.0, 0.3))

    command = controller.step(0.01, [0.0] * 7, [0.0] * 7)

    assert dict(controller.faults) == {Fault.BALL_BEFORE_BEGIN: 1}
    assert "allowed: one after it" in controller.last_fault
    assert not command.is_new


def test_a_perception_may_have_no_new_sample_and_knows_five_states(controller):
    controller.begin((0.9, 0.0))
    controller.measure(None)
    assert not controller.step(0.0, [0.0] * 7, [0.0] * 7).is_new
    assert not controller.faults

    controller.measure(BallSample((0.5, 0.0, 0.3), (-5.0, 0.0, 0.0), 9, 0.02))
    assert not controller.step(0.02, [0.0] * 7, [0.0] * 7).is_new

    assert dict(controller.faults) == {Fault.BALL_OUT_OF_RANGE: 1}
    assert controller.last_fault == "ball state is 9; allowed: 0, 1, 2, 3, 4"


@pytest.mark.parametrize(
    ("spoil", "fault", "text"),
    [
        (
            lambda t, p: (t, (p[0], NAN, p[2])),
            Fault.BALL_NOT_FINITE,
            r"ball_pos\[1\] is nan; allowed: -4 to 4",
        ),
        (lambda t, p: (t, (-INF, p[1], p[2])), Fault.BALL_NOT_FINITE, r"ball_pos\[0\] is -inf"),
        (lambda t, p: (t, tuple(1e3 * v for v in p)), Fault.BALL_OUT_OF_RANGE, r"allowed: -4 to 4"),
        (lambda t, p: (NAN, p), Fault.BALL_NOT_FINITE, "ball moment is nan; allowed: a finite time"),
        (lambda t, p: (t - 0.1, p), Fault.BALL_OUT_OF_ORDER, "allowed: a later one"),
        (lambda t, p: (t + 1.7e9, p), Fault.BALL_CLOCK, r"allowed: -0.5 to \+0.02 s"),
    ],
)
def test_a_bad_detection_is_named_and_counts_as_a_lost_one(parts, spoil, fault, text):
    bad, lost = Controller(*parts), Controller(*parts)
    # Step 6 is spoilt in one controller, and not detected by the other's camera at all
    commands = play_ball(bad, spoil=lambda k, t, p: spoil(t, p) if k == 6 else (t, p))
    lost_commands = play_ball(lost, spoil=lambda k, t, p: (NAN, p) if k == 6 else (t, p))

    assert set(bad.faults) == {fault}
    assert bad.faults[fault] == 3  # detections of a 180 Hz camera in one step
    assert re.search(text, bad.last_fault)
    np.testing.assert_array_equal(positions(commands), positions(lost_commands))


def test_a_clock_that_is_set_back_costs_the_ball_in_flight_and_not_the_next_detections(controller):
    play_ball(controller, start=20.0)

    home, still = controller.contract.of_joints("home"), np.zeros(7)
    commands = []
    for moment, pos in detections(10 * PERIOD):
        controller.see(1.0 + moment, pos)
    for step in range(12):
        commands.append(controller.step(1.0 + step * PERIOD, home, still))

    assert controller.faults[Fault.CLOCK] == 1
    assert not commands[0].is_new
    assert all(command.is_new for command in commands[1:])
    assert controller._tracker.newest < 2.0
    for step in range(40):
        last = controller.step(1.3 + step * PERIOD, home, still)
    assert not last.is_new  # a ball that was not detected for 0.5 s is lost


@pytest.mark.parametrize(
    ("value", "fault"),
    [(NAN, Fault.JOINTS_NOT_FINITE), (INF, Fault.JOINTS_NOT_FINITE), (180.0, Fault.JOINTS_OUT_OF_RANGE)],
)
@pytest.mark.parametrize("which", [0, 1])
def test_bad_joints_are_held_over_for_three_steps_and_then_the_targets_stay(controller, value, fault, which):
    def joints(step, pos, vel):
        if step >= 4:
            (pos, vel)[which][3] = value
        return pos, vel

    commands = play_ball(controller, joints=joints)

    assert np.isfinite(positions(commands)).all()
    assert [command.is_new for command in commands] == [True] * (4 + MAX_HELD) + [False] * (8 - MAX_HELD)
    assert controller.faults == {fault: 8}
    np.testing.assert_array_equal(
        positions(commands)[4 + MAX_HELD :] - positions(commands)[3 + MAX_HELD], 0.0
    )


def test_bad_joints_before_any_good_ones_are_refused_by_name(controller):
    with pytest.raises(ValueError, match=r"joint_pos\[2\] is nan; .*; the first step needs the joints"):
        controller.step(0.0, [0.0, 0.0, NAN, 0.0, 0.0, 0.0, 0.0], [0.0] * 7)


def test_without_a_ball_the_robot_stays_where_it_stands(controller):
    stands = [0.1, -0.2, 0.3, 1.0, 1.2, 0.9, 3.1]  # the roll is out of its range of 2.9 rad
    command = controller.step(0.0, stands, [0.0] * 7)

    assert not command.is_new
    np.testing.assert_allclose(command.positions, [*stands[:6], 2.9])


def test_a_ball_that_is_seen_no_more_changes_no_target(controller):
    commands = play_ball(controller)
    home, still = controller.contract.of_joints("home"), np.zeros(7)
    later = controller.step(1.0 + 12 * PERIOD + MAX_AGE, home, still)

    assert not later.is_new
    np.testing.assert_array_equal(later.positions, commands[-1].positions)


@pytest.mark.parametrize("now", [NAN, INF, 1.0])
def test_a_clock_that_stops_or_is_no_number_costs_one_step(controller, now):
    commands = play_ball(controller)
    home, still = controller.contract.of_joints("home"), np.zeros(7)
    stopped = controller.step(now, home, still)
    goes_on = controller.step(1.0 + 12 * PERIOD, home, still)

    assert not stopped.is_new
    assert controller.faults == {Fault.CLOCK: 1}
    np.testing.assert_array_equal(stopped.positions, commands[-1].positions)
    assert goes_on.is_new


def test_an_observation_that_is_not_finite_changes_no_target(parts):
    contract, network = parts
    huge = contract.kinematics.model_dump() | {"racket": (1e39, *contract.kinematics.racket[1:])}
    controller = Controller(
        contract.model_copy(update={"kinematics": Kinematics.model_validate(huge)}), network
    )
    commands = play_ball(controller)

    assert np.isfinite(positions(commands)).all()
    assert not any(command.is_new for command in commands)
    assert controller.faults[Fault.OBSERVATION_NOT_FINITE] == len(commands)
    assert controller.last_fault == "observation[14] is -inf"


def test_an_action_that_is_not_finite_changes_no_target(parts):
    class Broken:
        def act(self, obs):
            return np.full((1, 7), NAN, np.float32)

    contract, _ = parts
    commands = play_ball(broken := Controller(contract, Broken()))

    assert not any(command.is_new for command in commands)
    assert np.isfinite(positions(commands)).all()
    assert broken.faults == {Fault.ACTION_NOT_FINITE: len(commands)}


@pytest.mark.parametrize("target", [(NAN, 0.0), (0.9, INF), (-0.5, 0.0), (0.9, 1.0)])
def test_a_target_off_the_opponents_court_is_refused(controller, target):
    with pytest.raises(ValueError, match=r"allowed: x in 0\.\.1\.37"):
        controller.begin(target)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (
            lambda out: (out / "contract.json").unlink(),
            r"no exported policy in .*No such file.*\(contract.json\)",
        ),
        (
            lambda out: (out / "policy.onnx").write_bytes(b"x"),
            "policy.onnx has SHA-256 .*; its contract allows",
        ),
        (lambda out: edit(out, '"half_range": 0.75', '"half_range": NaN'), r"joints.0.half_range: .*finite"),
        (
            lambda out: edit(out, '"half_range": 0.75', '"half_range": -1'),
            r"joints.0.half_range: .*greater than 0",
        ),
        (
            lambda out: edit(out, '"history": 0', '"history": 2'),
            "observation is not the layout of its options",
        ),
        (lambda out: edit(out, "topspin-robot 1", "topspin-robot 9"), "format: .*'topspin-robot 1'"),
    ],
)
def test_a_folder_that_cannot_be_used_is_one_line(tmp_path, spoil, line):
    out = tmp_path / "out"
    export(small_policy(), out, "small")
    spoil(out)

    with pytest.raises(ReportedError, match=line):
        load(out)


def edit(out, old, new):
    text = (out / "contract.json").read_text()
    assert old in text
    (out / "contract.json").write_text(text.replace(old, new, 1))


def test_a_detection_takes_the_place_of_a_sample_of_the_same_ball(controller):
    home = controller.contract.of_joints("home")
    controller.begin((0.9, 0.0))
    controller.measure(BallSample((0.5, 0.0, 0.3), (-5.0, 0.0, 0.0), 0, 0.0))
    assert controller.step(0.0, home, [0.0] * 7).is_new
    for k in range(1, 40):
        controller.see(0.01 * k, (0.5 - 0.02 * k, 0.0, 0.3))
    before = controller.step(0.4, home, [0.0] * 7)
    after = controller.step(0.4 + MAX_AGE + 0.1, home, [0.0] * 7)

    assert before.is_new
    assert not after.is_new  # the ball of the detections is lost; the sample is not played for ever
