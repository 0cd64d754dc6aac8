"""The exported network as a LEAPP pipeline: the file that NVIDIA's Isaac tools read (configuration 1.3)."""

import hashlib
import json
from typing import Any, Final

from topspin.export.onnx_graph import OPSET, TARGETS
from topspin.robot.contract import POLICY_FILE, RobotContract
from topspin.robot.network import INPUT, OUTPUT

CONFIG_VERSION: Final = "1.3"
NODE: Final = "policy"


def leapp_yaml(contract: RobotContract, network: bytes) -> str:
    """Return the pipeline's description. It is JSON, which every YAML reader reads.

    The pipeline is the network alone. Its input is made by the observer of the wheel, which keeps what it knows of the
    ball from step to step and is no graph of tensors.

    Args:
        contract: Of the policy.
        network: The ONNX file.
    """
    numbers = [f"{part.name}_{k}" for part in contract.observation for k in range(part.size)]
    joints = contract.joint_names

    def tensor(name: str, kind: str, elements: list[str]) -> dict[str, Any]:
        return {
            "name": name,
            "dtype": "float32",
            "shape": [1, len(elements)],
            "type": "tensor",
            "kind": kind,
            "element_names": [elements],
        }

    outputs = [tensor(OUTPUT, "action", joints), tensor(TARGETS, "target/joint/position", joints)]
    found = {
        "models": {
            NODE: {
                "inputs": [tensor(INPUT, "state/observation", numbers)],
                "outputs": outputs,
                "parameters": {
                    "model_path": POLICY_FILE,
                    "md5sum": hashlib.md5(network, usedforsecurity=False).hexdigest(),
                    "sha256sum": hashlib.sha256(network).hexdigest(),
                    "backend": "onnx",
                    "opset_version": OPSET,
                },
            }
        },
        "pipeline": {
            "data_flow": {},
            "feedback_flow": {},
            "inputs": {NODE: [INPUT]},
            "outputs": {NODE: [OUTPUT, TARGETS]},
            "configs": {"frequency": contract.control_rate_hz},
        },
        "system information": {"leapp config version": CONFIG_VERSION, **contract.made_with},
    }
    return json.dumps(found, indent=2) + "\n"
