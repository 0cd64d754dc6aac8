"""The folder of an exported policy: network, contract, wheel, model card and example."""

import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from common.errors import ReportedError
from common.evaluation.config import MatchSpin
from common.policy.contract import PolicyError
from common.policy.folder import Policy
from topspin.export.wheel import build_wheel
from topspin.robot.contract import CONTRACT_FILE, POLICY_FILE, RobotContract, sha256_of

log = logging.getLogger(__name__)

EXAMPLE: Final = Path(__file__).with_name("example.py")
CHECKED: Final = 1000  # observations on which the written network is compared with the policy's own
TOLERANCE: Final = 1e-5  # largest difference of an action


def check_free(out: Path, flag: str = "--out") -> None:
    """Raise ReportedError unless ``out``, which ``flag`` names, is new or an empty folder."""
    if out.is_dir() and out.samefile("."):
        raise ReportedError(
            f"{out} is the current folder, which can't be replaced; allowed: another one ({flag})"
        )
    if out.is_dir() and not any(out.iterdir()):
        return
    if out.exists() or out.is_symlink():
        kind = "is not empty" if out.is_dir() else "is no folder"
        raise ReportedError(f"{out} {kind}; allowed: a new or an empty folder ({flag})")


def export_policy(
    policy: Policy, name: str, out: Path, expected_spin: MatchSpin = "contract"
) -> tuple[RobotContract, float]:
    """Write the folder of a policy; return its contract, and the largest difference of an action from the policy's.

    Args:
        policy: The policy.
        name: What it is called.
        out: New or empty. It is complete or untouched: all files are written beside it first.
        expected_spin: What the observer expects of the balls' spin.

    Raises:
        ReportedError: The policy can't be used by a robot, a library is missing, or the folder can't be written.
    """
    if policy.contract.task.observation.spin == "true":
        raise PolicyError(
            f"policy {name!r} observes the true spin; allowed: a policy with spin estimated or hidden"
        )
    with whole_folder(out) as fresh:
        return _write(policy, name, fresh, expected_spin)


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """Yield a folder beside ``out`` to write into, which then becomes ``out``; after an error ``out`` is untouched.

    Raises:
        ReportedError: It can't be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise ReportedError(f"can't write beside {out}: {error.strerror}") from None
    try:
        yield fresh
        fresh.chmod(0o777 & ~_umask())  # mkdtemp's is its owner's alone
        if out.is_dir():
            out.rmdir()
        fresh.rename(out)
    except OSError as error:
        raise ReportedError(f"can't write {out}: {error.strerror}") from None
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _umask() -> int:
    """Return the permissions that new files of this process don't have."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def write_network(
    policy: Policy, name: str, folder: Path, expected_spin: MatchSpin = "contract"
) -> tuple[RobotContract, float]:
    """Write a policy's network; return its contract, and the largest difference of an action from the policy's.

    Raises:
        ReportedError: A library is missing, or the written network is not the policy's.
    """
    try:  # an extra
        import onnx  # noqa: PLC0415

        from topspin.export.onnx_graph import add_metadata, policy_graph  # noqa: PLC0415
        from topspin.export.robot_contract import robot_contract  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise ReportedError(f"an export needs {error.name}: pip install -e '.[export]'") from None
    outline = robot_contract(policy.contract.expecting(expected_spin), name, "")
    model = policy_graph(policy, outline.of_joints("middle"), outline.of_joints("half_range"))
    add_metadata(model, outline)
    onnx.save_model(model, folder / POLICY_FILE)
    parity = parity_of(policy, folder / POLICY_FILE)
    if not parity <= TOLERANCE:  # not-a-number too
        raise ReportedError(f"the written network's actions differ by {parity:.1e}; allowed: {TOLERANCE:g}")
    return outline.model_copy(update={"policy_sha256": sha256_of(folder / POLICY_FILE)}), parity


def _write(policy: Policy, name: str, folder: Path, expected_spin: MatchSpin) -> tuple[RobotContract, float]:
    contract, parity = write_network(policy, name, folder, expected_spin)
    from topspin.export.leapp import leapp_yaml  # noqa: PLC0415
    from topspin.export.model_card import model_card  # noqa: PLC0415

    (folder / CONTRACT_FILE).write_text(contract.model_dump_json(indent=2) + "\n")
    wheel = build_wheel(folder).name
    example = EXAMPLE.read_text()
    (folder / "example.py").write_text(example)
    (folder / "leapp.yaml").write_text(leapp_yaml(contract, (folder / POLICY_FILE).read_bytes()))
    (folder / "README.md").write_text(model_card(contract, example, wheel, parity))
    return contract, parity


def parity_of(policy: Policy, file: Path) -> float:
    """Return the largest difference between actions of a written network and the policy's.

    The observations are drawn as widely as those of the training.
    """
    from topspin.robot.network import Network  # noqa: PLC0415

    width = policy.network.obs_size
    moments, noise = policy.moments.first(width), np.random.default_rng(0).normal(size=(CHECKED, width))
    obs = (moments.mean + np.sqrt(moments.var) * noise).astype(np.float32)
    difference = Network(file, width).act(obs) - np.clip(policy.act(obs), -1.0, 1.0)
    return float(np.abs(difference).max())
