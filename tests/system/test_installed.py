"""The source distribution and the wheel, as a release builds them, installed into a fresh environment without sources.

The environment reads the libraries of the one that runs the tests, but not its Topspin.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from tests.system.commands import TINY

ROOT = Path(__file__).parents[2]
PACKAGES = ("common", "services", "deploy", "topspin")
SOURCES = (*PACKAGES, "pyproject.toml", "README.md")
NO_SOURCES = shutil.ignore_patterns("__pycache__", ".numba_cache", "*.egg-info")
DATA = (
    *(
        f"common/policies/{name}/{file}"
        for name in ("default", "mild", "paper")
        for file in ("contract.json", "weights.safetensors")
    ),
    *("common/robot/robots/rails/robot.xml", "common/robot/robots/usst/robot.toml"),
    *("deploy/recipes/paper.toml", "topspin/report/page.html.j2", "topspin/export/example.py"),
)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Return the source distribution and the wheel that is built from it."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=NO_SOURCES)
        else:
            shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    return sdist, wheel


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """Return the folder of an environment's programs, with the wheel installed."""
    home = tmp_path_factory.mktemp("venv")
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "--python",
            python,
            "install",
            "--quiet",
            "--no-index",
            "--no-deps",
            built[1],
        ],
        check=True,
    )
    (packages,) = home.glob("lib/python*/site-packages")
    (packages / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin"


def run(folder, *command):
    """Return what an installed program prints, run in ``folder``."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "TOPSPIN_"))
    }
    # Equal sources: kernels that this working copy has compiled are found by their content
    environment |= {"NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", str(ROOT / ".numba_cache"))}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_wheel_and_source_distribution_hold_the_data_and_the_wheel_nothing_but_the_packages(built):
    sdist, wheel = built
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = set(archive.namelist())

    assert set(DATA) <= in_sdist
    assert set(DATA) <= in_wheel
    roots = {name.partition("/")[0] for name in in_wheel}
    assert {root for root in roots if not root.endswith(".dist-info")} == set(PACKAGES)


def test_an_installed_policy_of_the_box_plays_and_trains_in_another_folder(installed, tmp_path):
    code = "import common.policy.box as box; print(box.__file__, box.names())"
    place = run(tmp_path, installed / "python", "-c", code)
    measured = json.loads(
        run(tmp_path, installed / "topspin", *["evaluate", "--policy", "default", "--rallies", "8", "--json"])
    )
    flags = ["--run", "r", "--frames", "1024", "--evaluate", "false", *TINY]
    trained = json.loads(run(tmp_path, installed / "topspin", "train", *flags))

    assert place.startswith(str(installed.parent))
    assert "'default', 'mild', 'paper'" in place
    assert measured["rallies"] == 8
    assert measured["return_rate"] >= 0.5
    assert trained["frames"] >= 1024
    assert sorted(path.name for path in tmp_path.iterdir()) == ["runs"]


def test_the_wheel_says_where_the_project_is_and_for_which_python(installed, tmp_path):
    code = "from importlib.metadata import metadata; print(metadata('topspin').as_string())"
    text = run(tmp_path, installed / "python", "-c", code)

    for part in (
        "Project-URL: Paper",
        "Classifier: Programming Language :: Python :: 3.13",
        "Requires-Python:",
    ):
        assert part in text
    assert run(tmp_path, installed / "topspin", "--version").startswith("topspin ")
