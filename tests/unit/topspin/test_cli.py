"""The `topspin` command: its subcommands, their help, and its mistakes."""

import subprocess
import sys
from importlib import import_module
from threading import Event

import pytest

from common.errors import ConfigError, HelpRequest
from common.robot.chain_of import chain_of
from topspin.__main__ import COMMANDS, dispatch

CHAIN = chain_of("rails")

NEVER = Event()


def help_of(*argv):
    with pytest.raises(HelpRequest) as caught:
        dispatch(argv, NEVER)
    return str(caught.value)


def test_help_lists_every_command_within_80_columns():
    text = help_of("--help")

    assert all(f"  {name}" in text for name in COMMANDS)
    assert max(map(len, text.splitlines())) <= 80
    assert help_of() == text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_short_and_a_long_help(name):
    short, whole = help_of(name, "--help"), help_of(name, "--help-all")

    assert short.startswith(f"usage: topspin {name}")
    assert sum(line.startswith("  --") for line in short.splitlines()) <= 14
    assert len(whole) > len(short) or "--help-all" not in short
    assert max(map(len, whole.splitlines())) <= 80


def test_the_version_is_the_packages():
    assert help_of("--version").startswith("topspin 0.")


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("pley", "unknown command 'pley'; did you mean 'play'?"),
        ("x", "allowed: train, scale, play, evaluate"),
    ],
)
def test_an_unknown_command_is_one_line(word, line):
    with pytest.raises(ConfigError, match=line):
        dispatch([word], NEVER)


def test_importing_topspin_registers_the_environments_and_offers_policies():
    import gymnasium

    import topspin

    assert "topspin/Rally-v0" in gymnasium.registry
    policy = topspin.load_policy("paper")
    observer = topspin.Observer(policy.contract.task)
    observer.begin((0.9, -0.3))
    ball = topspin.BallSample((0.5, 0.0, 0.3), (-5.0, 0.0, 0.0), 0, 0.0)
    obs = observer.observe(0.02, [0.0] * 7, [0.0] * 7, ball)
    assert policy.act(obs[None]).shape == (1, 7)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        topspin.nothing  # noqa: B018


def test_gymnasium_imports_topspin_for_an_id_with_its_name():
    code = "import gymnasium; print(gymnasium.make('topspin:topspin/Rally-v0').spec.id)"

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout == "topspin/Rally-v0\n"


@pytest.mark.parametrize("program", ["deploy.manifests", "topspin.reference"])
@pytest.mark.parametrize(("flag", "status"), [("--help", 0), ("--check", 2)])
def test_only_the_bare_command_writes_files_of_the_repository(monkeypatch, program, flag, status):
    module = import_module(f"{program}.__main__")
    monkeypatch.setattr("sys.argv", [program, flag])
    monkeypatch.setattr(module, "files", lambda: pytest.fail("it writes"))

    with pytest.raises(SystemExit) as ended:
        module.main()

    assert ended.value.code == status
