"""`topspin export`: write a policy as a folder for a robot, or as a page that plays it in a browser."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field

from common.errors import ConfigError
from common.evaluation.config import MatchSpin
from common.service.config import load
from common.service.log import set_up_logging
from common.service.process import DONE

PROG: Final = "topspin export"


class ExportConfig(BaseModel):
    """Write a policy as a folder for a robot, in the form of a Hugging Face model.

    policy.onnx: the network with its normaliser. contract.json: observation, joints, filters, conditions and measures
    as data. A wheel that makes the observation from a camera's detections, without torch and MuJoCo. README.md: the
    model card. example.py, and leapp.yaml for NVIDIA's Isaac tools.

    With --web: a page instead, as a folder for any file server. The browser simulates robot and ball, and runs the
    policy.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)
    often: ClassVar = {
        "The policy": ("policy", "expected_spin"),
        "What is written": ("out", "web", "json"),
    }

    policy: str = Field(
        "default", description="a policy of the box, or a policy folder: runs/NAME/policy/latest"
    )
    out: str = Field("", description="folder to write; it must be new or empty; empty: exported")
    web: str = Field(
        "",
        description="write a page that plays the policy in a browser into this new or empty folder, instead of --out; "
        "npm fetches its libraries once (44 MB), and the page itself needs no network",
    )
    expected_spin: MatchSpin = "contract"
    json_line: bool = Field(False, alias="json", description="print what was written as one JSON object")


def main(argv: Sequence[str], _stop: Event) -> int:
    """Export; return the exit status."""
    config = load(ExportConfig, argv, prog=PROG, section="export")
    set_up_logging("info", "export")
    from common.policy.box import policy_folder
    from common.policy.folder import load_policy
    from topspin.export.folder import check_free, export_policy

    if config.web and config.out:
        raise ConfigError(f"--out {config.out} and --web {config.web}; allowed: one of them")
    out = Path(config.web or config.out or "exported")
    check_free(out, "--web" if config.web else "--out")
    source = policy_folder(config.policy)
    policy = load_policy(source)
    name = policy.contract.run if source.name in ("", "latest", "best") else source.name
    robot = policy.contract.task.robot
    if config.web:
        from topspin.web.folder import write_page

        parity = write_page(policy, name, out, config.expected_spin)
        following = f"python -m http.server --bind 127.0.0.1 --directory {out}"
    else:
        _, parity = export_policy(policy, name, out, config.expected_spin)
        following = f"pip install {out}/*.whl; python -m topspin_robot {out}"
    files = sorted(path.name for path in out.iterdir())
    if config.json_line:
        found = {"out": str(out), "policy": name, "robot": robot, "files": files, "parity_max": parity}
        sys.stdout.write(json.dumps(found) + "\n")
    else:
        sys.stdout.write(
            f"policy {name} for robot {robot} is in {out}: {', '.join(files)}\n"
            f"its actions in ONNX Runtime differ from the policy's by at most {parity:.1e}\n"
            f"next: {following}\n"
        )
    return DONE
