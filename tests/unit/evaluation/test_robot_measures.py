"""The robot's measures: from what MuJoCo recorded, rally by rally."""

import numpy as np
import pytest

from common.env.local_rallies import LocalRallies
from common.env.rally_env import RallyEnv
from common.evaluation.robot_measures import RobotMonitor, RobotRecord, robot_measures
from common.task.config import TaskConfig
from common.task.experience import MATCH

LINKS = ("upper_arm", "forearm", "wrist", "racket")
JOINTS = ["rail_x", "rail_y", "yaw", "pitch", "elbow", "wrist", "roll"]


def make_record(count: int, **columns) -> RobotRecord:
    plain = {
        "depth": np.zeros((count, 4)),
        "self_force": np.zeros((count, 4)),
        "table_force": np.zeros((count, 4)),
        "speed": np.full((count, 7), 0.5),
        "saturated": np.zeros((count, 7)),
        "clipped": np.zeros((count, 7)),
        "racket_speed": np.full(count, np.nan),
        "off_centre": np.full(count, np.nan),
    }
    return RobotRecord(**plain | columns)


def measured(record: RobotRecord) -> dict:
    return robot_measures(record, LINKS, JOINTS)


def test_a_rally_counts_once_however_many_links_are_deep():
    depth = np.zeros((4, 4))
    depth[0, 2:] = 0.003
    depth[1, 3] = 0.0019
    found = measured(make_record(4, depth=depth))

    assert found["self_penetration_share"] == 0.25
    assert found["self_penetration_by_link"] == {"upper_arm": 0, "forearm": 0, "wrist": 0.25, "racket": 0.25}


def test_a_table_strike_is_a_force_over_50_newton():
    force = np.zeros((4, 4))
    force[:, 3] = [49.9, 50.1, 0.0, 200.0]
    found = measured(make_record(4, table_force=force))

    assert found["table_strike_share"] == 0.5
    assert found["table_force_n"]["max"] == 200.0
    assert found["table_force_n_by_link"]["racket"]["p50"] == pytest.approx(50.0)
    assert found["table_force_n_by_link"]["forearm"] == {"p50": 0.0, "p99": 0.0, "max": 0.0}


def test_the_largest_joint_speed_is_that_of_all_rallies_and_by_joint():
    speed = np.full((2, 7), 0.5)
    speed[1, 4] = 1.04
    found = measured(make_record(2, speed=speed))

    assert found["speed_over_limit_max"] == 1.04
    assert found["speed_over_limit_by_joint"]["elbow"] == 1.04
    assert found["speed_over_limit_by_joint"]["roll"] == 0.5


def test_a_hit_beyond_85_percent_of_the_radius_is_on_the_rim():
    found = measured(make_record(4, off_centre=np.array([0.84, 0.86, np.nan, 0.1])))

    assert found["rim_hit_share"] == pytest.approx(0.3333)


def test_without_a_hit_there_is_no_racket_speed_and_no_rim():
    found = measured(make_record(3))

    assert found["rim_hit_share"] is None
    assert found["racket_speed_m_per_s"] == {"p50": None, "p99": None, "max": None}


@pytest.fixture(scope="module")
def played():
    """48 robots whose targets jump at random, and the records of their steps by hand."""
    env = RallyEnv(48, TaskConfig(), LocalRallies(1), stage=3, experience=MATCH, keeps_hits=True)
    monitor = RobotMonitor(env)
    env.reset()
    rng = np.random.default_rng(0)
    rallies, running, clipped = [], [[] for _ in range(48)], [[] for _ in range(48)]
    for _ in range(80):
        actions = (env.home_action + 0.6 * rng.standard_normal((48, 7))).astype(np.float32)
        step = env.step(actions)
        monitor.update(actions, step)
        motion = env.motion
        path = np.concatenate([motion.start_pos[:, None], motion.joint_pos], axis=1)
        speed = np.abs(np.diff(path, axis=1)) / 0.004 / [3.1, 3.3, 15, 15, 15, 15, 15]
        for row in range(48):
            running[row].append(speed[row].max(axis=0))
            clipped[row].append(np.abs(actions[row]) > 1)
        for row, validated in zip(step.finished.rows, step.finished.validated, strict=True):
            if validated:
                rallies.append((np.max(running[row], axis=0), np.mean(clipped[row], axis=0)))
            running[row], clipped[row] = [], []
    return monitor.record(), rallies


def test_every_rally_has_its_own_largest_speed_and_share_of_clipped_commands(played):
    record, rallies = played

    assert len(record.speed) == len(rallies) > 40
    speeds, shares = (np.array(sorted(map(tuple, column))) for column in zip(*rallies, strict=True))
    np.testing.assert_allclose(sorted(map(tuple, record.speed)), speeds)
    np.testing.assert_allclose(sorted(map(tuple, record.clipped)), shares)


def test_robots_with_targets_that_jump_touch_themselves_and_are_measured(played):
    record, _ = played

    assert record.self_force.max() > 20.0
    assert (record.saturated > 0.0).any()
    assert np.all(record.saturated <= 1.0)
    assert np.all(record.depth < 0.05)


def test_records_of_several_matches_are_put_together():
    both = RobotRecord.together([make_record(2), make_record(3)])

    assert both.speed.shape == (5, 7)
    assert both.of(np.array([True, False, False, True, False])).depth.shape == (2, 4)
