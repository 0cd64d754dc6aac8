"""The page's libraries: pinned by their content, or one line that says what to do."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from threading import Event

import pytest

from common.errors import ReportedError
from topspin.export import command
from topspin.web import packages
from topspin.web.packages import PACKAGES, PackageError

NPM = shutil.which("npm")


def test_an_archive_with_other_content_is_refused():
    with pytest.raises(PackageError, match=r"three@\S+ from npm is sha512-.*; allowed: sha512-"):
        packages.check(PACKAGES[-1], b"something else")


def test_an_archive_is_known_by_its_sha512():
    empty = "sha512-z4PhNX7vuL3xVChQ1m2AB9Yg5AULVxXcg/SpIdNs6c5H0NE8XYXysP+DGNKHfuwvY7kxvUdBeoGlODJ6+SfaPg=="

    packages.check(replace(PACKAGES[0], integrity=empty), b"")


def test_without_npm_the_command_says_what_to_do_and_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "")

    with pytest.raises(ReportedError, match=r"needs npm .* isn't installed; install it, or: .* copy it"):
        command.main(["--web", "page"], Event())

    assert os.listdir() == []


@pytest.mark.skipif(NPM is None, reason="no npm here")
def test_without_a_registry_the_command_says_what_to_do_and_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("npm_config_cache", str(tmp_path / "cache"))
    monkeypatch.setenv("npm_config_registry", "http://127.0.0.1:1")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    with pytest.raises(ReportedError, match=r"npm can't fetch .*three@.*: .*ECONNREFUSED.*; a written page"):
        command.main(["--web", "page"], Event())

    assert os.listdir() == []


@pytest.mark.parametrize("told", ["@mujoco/mujoco-3.14.0.tgz", "mujoco-mujoco-3.14.0.tgz"])
def test_an_old_npm_that_tells_another_name_than_its_files_is_understood(tmp_path, monkeypatch, told):
    answer = subprocess.CompletedProcess(
        [], 0, json.dumps([{"filename": told}, {"filename": "three-1.tgz"}]), ""
    )
    monkeypatch.setattr(packages.subprocess, "run", lambda *_given, **_more: answer)

    found = packages._archives("npm", tmp_path)

    assert found == [tmp_path / "mujoco-mujoco-3.14.0.tgz", tmp_path / "three-1.tgz"]
