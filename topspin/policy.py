"""A policy for people: loaded by its name in the box or from a folder."""

from pathlib import Path

from common.policy import folder
from common.policy.box import policy_folder
from common.policy.folder import Policy


def load_policy(name: str | Path = "default") -> Policy:
    """Return a policy: ``policy.act(obs)`` gives actions (B, 7) for observations (B, D), ``policy.contract`` says more.

    Args:
        name: A name in the box, or a policy folder; a ``Path`` is always a folder.

    Raises:
        PolicyError: There is no such policy, or it can't be read.
    """
    return folder.load_policy(name if isinstance(name, Path) else policy_folder(name))
