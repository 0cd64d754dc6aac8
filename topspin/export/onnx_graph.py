"""A policy's network as an ONNX graph, with the normaliser and the limits of the actions inside."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from common.policy.folder import Policy
from common.policy.normalizer import CLIP, scale_of
from common.policy.weights import state_tensors
from topspin.robot.contract import RobotContract
from topspin.robot.network import INPUT, OUTPUT

OPSET: Final = 17
IR_VERSION: Final = 8  # the one of opset 17: ONNX Runtime 1.12 and later read it
TARGETS: Final = "joint_targets"  # the second output: the actions as joint positions


def policy_graph(policy: Policy, middle: npt.ArrayLike, half_range: npt.ArrayLike) -> onnx.ModelProto:
    """Return the model: raw observations ``obs`` (N, D) in, ``actions`` and ``joint_targets`` (N, 7) out, float32.

    ((obs - mean) x scale, clipped to +-5) -> D2RL -> mean action -> clipped to +-1; targets are middle + half_range x
    action. It has no state: the policy has no memory.

    Args:
        policy: Network and normaliser.
        middle: Of each joint's range (7,) [m, rad].
        half_range: Of each joint (7,) [m, rad].
    """
    network = policy.network
    width, units = network.obs_size, [layer.out_features for layer in network.trunk.layers]
    tensors = state_tensors(network)
    moments = policy.moments.first(width)
    constants: dict[str, Any] = {
        "mean": moments.mean.astype(np.float32),
        "scale": (1.0 / scale_of(moments)).astype(np.float32),
        "low": np.float32(-CLIP),
        "high": np.float32(CLIP),
        "least": np.float32(-1.0),
        "most": np.float32(1.0),
        "middle": np.asarray(middle, np.float32),
        "half_range": np.asarray(half_range, np.float32),
    }
    nodes = [
        helper.make_node("Sub", [INPUT, "mean"], ["centred"]),
        helper.make_node("Mul", ["centred", "scale"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "low", "high"], ["normalised"]),
    ]

    def linear(layer: str, source: str, result: str) -> None:
        for kind in ("weight", "bias"):
            constants[f"{layer}.{kind}"] = tensors[f"{layer}.{kind}"]
        inputs = [source, f"{layer}.weight", f"{layer}.bias"]
        nodes.append(helper.make_node("Gemm", inputs, [result], transB=1))

    source = "normalised"
    for k in range(len(units)):
        if k > 0:  # D2RL: every hidden layer takes the observation again
            joined = f"joined_{k}"
            nodes.append(helper.make_node("Concat", [source, "normalised"], [joined], axis=1))
            source = joined
        linear(f"trunk.layers.{k}", source, f"linear_{k}")
        source = f"hidden_{k}"
        nodes.append(helper.make_node("Elu", [f"linear_{k}"], [source]))
    linear("mean", source, "mean_action")
    nodes += [
        helper.make_node("Clip", ["mean_action", "least", "most"], [OUTPUT]),
        helper.make_node("Mul", [OUTPUT, "half_range"], ["offset"]),
        helper.make_node("Add", ["offset", "middle"], [TARGETS]),
    ]
    joints = len(tensors["mean.bias"])
    graph = helper.make_graph(
        nodes,
        "topspin_policy",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["N", width])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", joints]) for name in (OUTPUT, TARGETS)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="topspin",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def add_metadata(model: onnx.ModelProto, contract: RobotContract) -> None:
    """Write what a program needs that has the file alone into its metadata, as text separated by commas.

    The names are those of mjlab's exporter where the meaning is the same. ``default_joint_pos`` is left out: there it
    is what action 0 stands for, which here is the middle of a joint's range and not its home.
    """

    def row(field: str) -> str:
        return ",".join(f"{getattr(joint, field):.9g}" for joint in contract.joints)

    helper.set_model_props(
        model,
        {
            "policy": contract.policy,
            "robot": contract.robot,
            "control_rate_hz": f"{contract.control_rate_hz:g}",
            "observation_names": ",".join(part.name for part in contract.observation),
            "observation_sizes": ",".join(str(part.size) for part in contract.observation),
            "joint_names": ",".join(contract.joint_names),
            "action_scale": row("half_range"),
            "action_offset": row("middle"),
            "joint_stiffness": row("kp"),
            "joint_damping": row("kv"),
        },
    )
