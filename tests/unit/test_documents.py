"""Every command of README and docs: its program exists and takes its flags and values. Programs in Python are run."""

import ast
import re
import shlex
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from threading import Event

import pytest

from benchmarks.settings import SECTION, BenchmarkConfig
from common.errors import HelpRequest
from common.service.config import load
from topspin.__main__ import COMMANDS, dispatch

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PLACEHOLDERS = {"LEARNER": "learner", "HOST_A": "host", "NAME": "arm", "$seed": "0", "N": "2", "DIR": "certs"}
OTHERS = {
    ".",
    "docker",
    "kubectl",
    "sbatch",
    "systemctl",
    "cp",
    "tensorboard",
}  # not ours: their files are checked
COMMAND = re.compile(
    rf"(?:[A-Z_]+=\S+ )?(?:topspin|python|make|pip|{'|'.join(map(re.escape, OTHERS))}) (?!/)"
)
IN_TEXT = re.compile(r"`((?:topspin|python -m|make) [^`]+)`")


def code_of(text):
    """Return the lines of indented and of fenced blocks, without those of other languages."""
    fence = None
    for line in text.replace("\\\n", " ").splitlines():
        if mark := re.match(r"\s*```(\w*)", line):
            fence = mark.group(1) if fence is None else None
        elif fence in ("", "text", "sh") or (fence is None and line.startswith("    ")):
            yield line.strip()


def commands():
    found = {}
    for page in PAGES:
        text = page.read_text()
        lines = [line for line in code_of(text) if COMMAND.match(line)]
        for line in [*lines, *(" ".join(words.split()) for words in IN_TEXT.findall(text))]:
            found.setdefault(re.sub(r"\s+#.*$", "", line), page.name)
    return found


FOUND = commands()


def words_of(line):
    """Return a command's words: without its environment, its redirections, and with values for placeholders."""
    words = shlex.split(line)
    while re.match(r"[A-Z_]+=", words[0]):
        words.pop(0)
    for name, value in PLACEHOLDERS.items():
        words = [re.sub(rf"(?<![A-Za-z]){re.escape(name)}(?![A-Za-z])", value, word) for word in words]
    return [word.strip("[]") for word in words]  # what may be left out


def printed(main, *arguments):
    """Return what a program prints that is asked for its settings: it has read all of its flags."""
    with pytest.raises(HelpRequest) as asked:
        main(*arguments)
    return str(asked.value)


def check_flags(program, flags, monkeypatch):
    """Let a program of ours read its flags. A run that is to be resumed is not there, so that flag is left out."""
    flags = [flag for flag in flags if flag != "--resume"]
    if not {"--help", "--help-all", "--version"} & set(flags):
        # A command without flags is only named: some of its settings may have to be given
        flags.append("--help" if program == "topspin" and len(flags) == 1 else "--print-config")
    if program == "topspin":
        printed(dispatch, ["--help"] if flags == ["--print-config"] else flags, Event())
    elif program.startswith("services."):
        monkeypatch.setattr(sys, "argv", [program, *flags])
        printed(import_module(f"{program}.__main__").main, Event())
    elif program in ("deploy.local", "deploy.router"):
        printed(import_module(program).main, flags, Event())
    elif program.startswith("benchmarks."):
        module = import_module(program)
        module = import_module(f"{program}.__main__") if hasattr(module, "__path__") else module
        (model,) = (
            found
            for found in vars(module).values()
            if isinstance(found, type)
            and issubclass(found, BenchmarkConfig)
            and found.__module__ == module.__name__
        )
        named = next(k for k, word in enumerate(flags) if word.startswith("--"))  # runs stand before
        printed(lambda: load(model, flags[named:], prog=program, section=SECTION))
    elif program not in ("pytest", "http.server"):
        parts = program.replace("topspin_robot", "topspin.robot").split(".")
        path = ROOT.joinpath(*parts)
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), program


def test_the_documents_have_commands():
    assert len(FOUND) > 90
    named = {name for name in COMMANDS for line in FOUND if line.startswith(f"topspin {name}")}
    assert set(COMMANDS) - named <= {"pictures"}  # which draws the README's


@pytest.mark.parametrize("line", FOUND, ids=lambda line: line[:60])
def test_a_command_of_the_documents_is_one_that_the_program_takes(line, monkeypatch):
    first, *rest = words_of(line)
    if first == "topspin":
        check_flags("topspin", rest, monkeypatch)
    elif first == "python" and rest[0].startswith("examples/"):  # tests/system/test_examples.py runs it
        assert (ROOT / rest[0]).is_file()
    elif first == "python":
        assert rest[0] == "-m"
        check_flags(rest[1], rest[2:], monkeypatch)
    elif first == "make":
        makefile = (ROOT / "Makefile").read_text()
        for word in rest:
            name = word.partition("=")[0]
            assert re.search(rf"^{name} \?=" if "=" in word else rf"^{name}:", makefile, re.MULTILINE), word
    elif first == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert set(re.findall(r"\[(\w+)\]", line)) <= set(extras)
    for word in rest:
        if re.match(r"(deploy|docs|benchmarks|tests)/", word):
            assert list(ROOT.glob(word)), word


@pytest.mark.parametrize("page", ["gymnasium.md", "policies.md"])
def test_the_python_programs_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL):
        exec(compile(ast.parse(block), page, "exec"), names)

    assert "env" in names or "policy" in names


def test_the_example_of_a_settings_file_says_what_differs_from_the_defaults():
    file = ROOT / "docs" / "night.toml"

    text = printed(dispatch, ["train", "--config", str(file), "--print-config"], Event())

    assert tomllib.loads(text) == tomllib.loads(file.read_text())


def test_a_message_that_the_pages_explain_is_one_that_a_program_says():
    folders = ("common", "services", "deploy", "topspin")
    text = "\n".join(file.read_text() for folder in folders for file in (ROOT / folder).rglob("*.py"))
    said = re.sub(r'"\s*\n\s*f?"', "", text)  # a long text is written in several pieces
    rows = [line for line in (ROOT / "docs/troubleshooting.md").read_text().splitlines() if line[:2] == "| "]
    messages = [message for row in rows for message in re.findall(r"`([^`]+)`", row.split("|")[1])]

    assert len(messages) > 20
    assert [message for message in messages if message not in said] == []
