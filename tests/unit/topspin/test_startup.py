"""What `--help`, `--version` and a mistyped flag load: settings are read before anything heavy is imported."""

import json
import subprocess
import sys

from topspin.__main__ import COMMANDS

HEAVY = {
    "torch",
    "mujoco",
    "numba",
    "zenoh",
    "scipy",
    "matplotlib",
    "onnx",
    "safetensors",
    "rich",
    "tensorboard",
}

# prints each program's status, and the modules that are loaded after all of them
PROGRAM = """
import json, sys
from importlib import import_module
from threading import Event
from common.errors import ConfigError, HelpRequest
from topspin.__main__ import COMMANDS, dispatch

def outcome(main, *arguments):
    try:
        main(*arguments)
    except (ConfigError, HelpRequest) as stopped:
        return f"{type(stopped).__name__}: {str(stopped)[:40]}"
    return "ran"

found = {}
for flag in ("--help", "--help-all", "--no-such-flag"):
    for name in COMMANDS:
        found[f"{name} {flag}"] = outcome(dispatch, [name, flag], Event())
    for name in ("deploy.local", "deploy.router"):
        found[f"{name} {flag}"] = outcome(import_module(name).main, [flag], Event())
    for name in ("actor", "generator", "evaluator", "learner"):
        sys.argv = [name, flag]
        found[f"{name} {flag}"] = outcome(import_module(f"services.{name}.__main__").main, Event())
print(json.dumps([found, sorted({name.split(".")[0] for name in sys.modules})]))
"""


def test_no_help_and_no_mistyped_flag_loads_a_heavy_library():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)

    outcomes, loaded = json.loads(done.stdout)
    assert len(outcomes) == 3 * (len(COMMANDS) + 6)
    for words, outcome in outcomes.items():
        begin = "ConfigError: unknown flag --no-such" if "no-such" in words else "HelpRequest: usage: "
        assert outcome.startswith(begin), words
    assert HEAVY & set(loaded) == set()


def test_the_version_loads_no_settings():
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "topspin", "--version"],
        capture_output=True,
        text=True,
        check=True,
    )

    loaded = {line.rpartition("|")[2].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert done.stdout.startswith("topspin ")
    assert {"topspin", "common"} <= loaded
    assert loaded & {*HEAVY, "pydantic", "numpy", "gymnasium"} == set()
