"""The locks hold what pyproject.toml allows: every package at one version, every file with its hash."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]


def locked(name):
    """Return versions and number of hashes by package."""
    text = (ROOT / "requirements" / name).read_text()
    entries = re.split(r"\n(?=[^\s#])", text.strip())
    found = {}
    for entry in entries:
        package, version = re.match(r"([\w.-]+)==([\w.+-]+)", entry).groups()
        found.setdefault(canonicalize_name(package), []).append(version)
        assert len(re.findall(r"--hash=sha256:[0-9a-f]{64}\b", entry)) >= 1, package
    return found


def wanted(texts):
    """Return the requirements of ``texts``, with those of the project's own extras."""
    for requirement in map(Requirement, texts):
        if requirement.name == PROJECT["name"]:
            for extra in requirement.extras:
                yield from wanted(EXTRAS[extra])
        else:
            yield requirement


@pytest.mark.parametrize(
    ("name", "texts"),
    [
        ("services.lock", PROJECT["dependencies"]),
        ("dev.lock", [*PROJECT["dependencies"], *EXTRAS["dev"]]),
    ],
)
def test_each_dependency_is_locked_at_an_allowed_version(name, texts):
    versions = locked(name)

    for requirement in wanted(texts):
        if requirement.name != "torch":
            found = versions.get(canonicalize_name(requirement.name), [])
            assert found, f"{requirement.name} is not in {name}: make lock"
            assert all(requirement.specifier.contains(version) for version in found), (requirement, found)
    assert not any(package == "torch" or package.startswith("nvidia") for package in versions)


def test_the_container_gets_the_versions_that_the_tests_have_seen():
    services, dev = locked("services.lock"), locked("dev.lock")

    assert {package: dev.get(package) for package in services} == services


def test_the_locks_leave_out_the_torch_of_the_project():
    (torch,) = (text for text in PROJECT["dependencies"] if text.startswith("torch"))

    assert (ROOT / "requirements/without-torch.txt").read_text().startswith(f"{torch} ;")
