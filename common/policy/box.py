"""The box: trained policies that come with the project, found by name from any working directory."""

from importlib.resources import files
from pathlib import Path
from typing import Final

from common.policy.contract import CONTRACT_FILE, NoPolicyError
from common.service.run_folder import LATEST, RUNS, RunFolder

BOX: Final = Path(str(files("common"))).resolve() / "policies"


def names() -> list[str]:
    """Return the names of the policies in the box."""
    return sorted(path.parent.name for path in BOX.glob(f"*/{CONTRACT_FILE}"))


def policy_folder(given: str) -> Path:
    """Return the folder of a policy that is given by its name in the box or by its folder.

    A name of the box means the box, whatever the working directory holds; ``./default`` is a folder.

    Raises:
        NoPolicyError: It is neither.
    """
    if given in names():
        return BOX / given
    folder = Path(given)
    if folder.parts[:2] == (RUNS.name, LATEST):  # the link may be missing
        folder = RunFolder.of(LATEST).root.joinpath(*folder.parts[2:])
    if not folder.exists():
        raise NoPolicyError(f"no policy {given!r}; allowed: a policy folder, or one of {', '.join(names())}")
    return folder
