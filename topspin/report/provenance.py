"""Provenance: the commands of the runs and of the report, and the versions and machine of the report."""

import os
import platform
import shlex
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from common.service.config import load, recipe_names, to_tables
from common.service.config_sources import flag_of
from deploy.config import RECIPES, SECTION, DeployConfig
from topspin.report.config import ReportConfig
from topspin.report.groups import leaves

PROGRAM: Final = "topspin train"
ALWAYS: Final = ("rallies", "seed", "launch", "policy")
"""Settings that the command of a report has also where they are the defaults."""
PACKAGES: Final = ("topspin", "numpy", "torch", "mujoco", "numba", "eclipse-zenoh")
NOT_IN_COMMAND: Final = frozenset(
    {"run", "recipe", "resume", "panel", "endpoint", "metrics_port"}
)  # named apart, or without a part in a run's result


@cache
def run_defaults(recipe: str) -> dict[str, Any]:
    """Return the settings of a run without other flags, by dotted path.

    Args:
        recipe: One of the package; empty: none.
    """
    argv = ["--recipe", recipe] if recipe else []
    config = load(DeployConfig, argv, prog=PROGRAM, section=SECTION, environ={}, recipes=RECIPES)
    return _by_path(to_tables(config, SECTION))


def _by_path(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {path.removeprefix(f"{SECTION}."): value for path, value in leaves(settings)}


def command(name: str, settings: Mapping[str, Any]) -> str:
    """Return the command that starts such a run: what its settings are besides its recipe or the defaults, as flags.

    A recipe from a file is spelled out: nobody knows whether the file is still the same.

    Args:
        name: The run's name.
        settings: The run's config.toml. A setting that there is no more is a flag too.
    """
    if SECTION not in settings:  # its services were started one by one
        return f"python -m services.learner --config runs/{name}/config.toml"
    own = _by_path(settings)
    recipe = own.get("recipe", "") if own.get("recipe") in recipe_names(RECIPES) else ""
    usual = run_defaults(recipe)
    words = [PROGRAM, "--run", name, *(("--recipe", recipe) if recipe else ())]
    for path, value in own.items():
        if path not in NOT_IN_COMMAND and (path not in usual or value != usual[path]):
            words += [f"--{flag_of(path)}", _text(value)]
    return " ".join(words[:1] + [shlex.quote(word) for word in words[1:]])


def own_command(config: ReportConfig) -> str:
    """Return the command of a report: its runs as they were given, what is often set, and what is not the default."""
    words = ["topspin", "report", *dict.fromkeys(config.runs)]
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if name not in ("runs", "out") and (name in ALWAYS or value != field.default):
            # A switch stands alone: a word behind it would be a run
            words += [f"--{flag_of(name)}"] if value is True else [f"--{flag_of(name)}", _text(value)]
    return shlex.join(words)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return ",".join(str(item) for item in value)
    return str(value)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide the numbers, and the commit if there is one."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    commit = commit_of(Path(__file__).parent)
    return found | ({"commit": commit} if commit else {})


def machine() -> dict[str, str]:
    """Return processor and cores of this machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {"processor": _processor(Path("/proc/cpuinfo")), "cores": str(cores), "system": platform.system()}


def _processor(cpuinfo: Path) -> str:
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def commit_of(folder: Path) -> str:
    """Return the commit of the sources, with + where they differ from it; empty outside a repository."""
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--exclude=*", "--abbrev=12", "--dirty=+"],
            cwd=folder, capture_output=True, text=True, check=True, timeout=10,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ""
    return described.stdout.strip()
