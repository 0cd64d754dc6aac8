"""The wheel: what is in it, and that it plays where there is nothing else of Topspin, no torch and no MuJoCo."""

import subprocess
import sys
import tomllib
import zipfile

import pytest

from tests.unit.topspin.export.exports import ROOT, export, small_policy
from topspin.export.wheel import (
    REQUIRES,
    REQUIRES_PYTHON,
    build_wheel,
    imports_of,
    modules,
    owner_of,
    renamed,
)

IN_THE_WHEEL = {
    "common": "__init__ errors jit",
    "common.perception": "__init__ bounce_prediction camera camera_filter cholesky flight_filter flight_track "
    "nominal_motion spin_posterior",
    "common.physics": "__init__ chain constants exponential flight flight_model fly impulse table_bounce "
    "touch vec",
    "common.rally": "__init__ hit observe observer sensing state",
    "common.task": "__init__ config counter_rng launch_presets observation randomization reward states",
    "topspin.robot": "__init__ __main__ contract controller faults made_up_ball network ros2 tracker",
}
BLOCKED = ("torch", "mujoco", "topspin", "common", "gymnasium", "zenoh", "safetensors", "msgpack")
RUN_BLOCKED = f"""
import runpy, sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED}:
            raise ImportError(f"{{name}} is blocked")
sys.meta_path.insert(0, Blocked())
runpy.run_path(sys.argv[1], run_name="__main__")
assert not set({BLOCKED}) & set(sys.modules)
"""


def test_the_wheel_holds_what_the_observer_needs_and_nothing_else():
    expected = {
        package if name == "__init__" else f"{package}.{name}"
        for package, names in IN_THE_WHEEL.items()
        for name in names.split()
    }

    assert set(modules()) == expected


def test_the_wheel_needs_only_what_it_declares_with_the_projects_bounds():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ours = {*project["dependencies"], *project["optional-dependencies"]["export"]}
    ros = {"rclpy", "builtin_interfaces", "geometry_msgs", "sensor_msgs", "std_msgs", "trajectory_msgs"}
    imported = {
        module.partition(".")[0]
        for file in modules().values()
        for node, module in imports_of(file.read_text())
        if not owner_of(module)
    }
    declared = {requirement.partition(">")[0] for requirement in REQUIRES}

    assert set(REQUIRES) <= ours
    assert project["requires-python"] == REQUIRES_PYTHON
    assert imported - set(sys.stdlib_module_names) - ros == declared


def test_equal_sources_make_equal_wheels(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    one, other = (build_wheel(tmp_path / name) for name in "ab")

    assert one.read_bytes() == other.read_bytes()
    assert all("common." not in line or "topspin_robot.common." in line for line in import_lines(one))


def import_lines(wheel):
    with zipfile.ZipFile(wheel) as archive:
        sources = [archive.read(name).decode() for name in archive.namelist() if name.endswith(".py")]
    lines = [line for source in sources for line in source.splitlines()]
    return [line for line in lines if line.startswith(("from common", "from topspin", "import "))]


@pytest.mark.parametrize(
    "line", ["import common.jit", "from topspin.policy import load_policy", "import deploy"]
)
def test_an_import_that_the_wheel_cannot_rename_is_refused(line):
    with pytest.raises(ValueError, match=r"line 1 .*; allowed:"):
        renamed(line)


def test_the_installed_wheel_runs_the_readmes_example_without_torch_mujoco_and_topspin(tmp_path):
    # The small policy observes no flight filter, so that a third as many kernels are compiled
    out, target = tmp_path / "exported", tmp_path / "site"
    export(small_policy(), out, "small")
    (wheel,) = out.glob("*.whl")
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
    subprocess.run([*install, str(target), str(wheel)], check=True, capture_output=True)
    done = subprocess.run(
        [sys.executable, "-c", RUN_BLOCKED, str(out / "example.py")],
        cwd=tmp_path,
        env={"PYTHONPATH": str(target), "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (out / "example.py").read_text() == (ROOT / "topspin" / "export" / "example.py").read_text()
    lines = done.stdout.splitlines()
    assert lines[0].startswith("[")
    assert lines[-1] == "{}"
    assert len(lines) == 21
