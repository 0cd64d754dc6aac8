"""The contract of an exported policy, made from the policy's own contract and the robot's description."""

from collections.abc import Mapping
from typing import Any

from common.physics.chain import IS_HINGE, Chain
from common.policy.contract import Contract
from common.robot.chain_of import chain_of
from common.robot.description import JointDrive, describe
from common.task.randomization import profile_of
from topspin.robot.contract import Filters, Joint, Kinematics, Numbers, RobotContract

MIN_CAMERA_NOISE = 0.0005  # [m] the camera filter assumes no less


def robot_contract(contract: Contract, name: str, policy_sha256: str) -> RobotContract:
    """Return the contract that goes with an exported policy.

    Args:
        contract: Of the policy.
        name: What the policy is called.
        policy_sha256: Of its ONNX file.

    Raises:
        RobotError: There is no such robot here.
    """
    task = contract.task
    profile = profile_of(task.randomization, task.rubber)
    chain = chain_of(task.robot)
    usual = 0.5 * (profile.observation_latency[0] + profile.observation_latency[1])
    return RobotContract(
        policy=name,
        policy_sha256=policy_sha256,
        robot=task.robot,
        control_rate_hz=task.control_rate_hz,
        observation=tuple(Numbers.model_validate(part) for part in contract.observation),
        action=tuple(Numbers.model_validate(part) for part in contract.action),
        options=task.observation,
        joints=tuple(_joint(drive, chain, index) for index, drive in enumerate(describe(task.robot).joint)),
        kinematics=Kinematics.of(chain),
        filters=Filters(
            camera_noise=max(profile.camera_noise, MIN_CAMERA_NOISE),
            position_noise=profile.position_noise,
            velocity_noise=profile.velocity_noise,
            observed_ago=usual,
        ),
        trained={
            "run": contract.run,
            "frames": contract.frames,
            "launch": task.launch,
            "flight": task.flight,
            "perception": task.perception,
            "randomization": task.randomization,
            "rubber": task.rubber,
            "observation_latency_s": profile.observation_latency,
            "action_latency_s": profile.action_latency,
            "position_noise_m": profile.position_noise,
            "velocity_noise_m_per_s": profile.velocity_noise,
            "lost_samples": profile.loss,
            "gain_factor": profile.gain_factor,
        },
        measures=measured_as(contract.measures, task.observation.expected_spin),
        made_with=contract.made_with,
    )


def measured_as(measures: Mapping[str, Any], expected_spin: str) -> dict[str, Any]:
    """Return the measures of an observer that expects this spin; others are those of another program."""
    return {
        name: found
        for name, found in measures.items()
        if not isinstance(found, Mapping) or found.get("expected_spin", expected_spin) == expected_spin
    }


def _joint(drive: JointDrive, chain: Chain, index: int) -> Joint:
    low, high = drive.range
    return Joint(
        name=drive.name,
        kind="hinge" if chain.joints[index, IS_HINGE] else "slide",
        middle=0.5 * (low + high),
        half_range=high - 0.5 * (low + high),
        home=drive.home,
        speed=drive.speed,
        force=drive.force,
        kp=drive.kp,
        kv=drive.kv,
    )
