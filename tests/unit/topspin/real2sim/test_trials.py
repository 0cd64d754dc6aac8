"""Small files that were once read wrongly: each comes to the right answer (skipped without the files)."""

import json
import re
import warnings
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from common.errors import ReportedError
from common.policy.folder import save_policy
from common.service.process import DONE
from common.task.launch import KIND
from common.task.launch_presets import SERVE
from tests.unit.evaluation.test_match import make_policy
from topspin.real2sim import command
from topspin.real2sim.config import Real2SimConfig
from topspin.real2sim.dataset import read
from topspin.real2sim.fit.bounces import touches
from topspin.real2sim.fit.identify import fit
from topspin.real2sim.formats.recordings import load
from topspin.real2sim.formats.tracks import RecordingError
from topspin.real2sim.replay import of_fits

TRIALS = Path(__file__).resolve().parents[5] / "shared" / "data" / "trials"

pytestmark = pytest.mark.skipif(not TRIALS.is_dir(), reason=f"no trial files in {TRIALS}")

BOUNCE = (0.3673, (-0.469, -0.020))  # of the ball that most files hold
# Files with that ball: samples that are left, and what is dropped
READ = {
    "plain_180hz.csv": (125, {}),
    "bom_crlf.csv": (125, {}),
    "fast_1000hz.csv": (700, {}),
    "noisy_250hz.csv": (175, {}),
    "units_in_header.csv": (125, {}),
    "dotted_header.csv": (125, {}),
    "decimal_comma.csv": (125, {}),
    "utf16.csv": (125, {}),
    "missing_cells.csv": (120, {"sample that is not finite": 5}),
    "infinite_cell.csv": (124, {"sample that is not finite": 1}),
}
# Files with a frame or a header that is missing: the error, and the sidecar that it asks for
CURED = {
    "no_header.csv": (r"add the first line t;x;y;z \(or columns = (.*) in no_header\.toml\)", "columns = {}"),
    "swapped_axes.csv": (
        r"the ball flies along y, not -x; set axes = (.*) in swapped_axes\.toml",
        "axes = {}",
    ),
    "millimetres.csv": (
        r"metres of this file look like millimetres .*; set length_unit = (.*) in millimetres\.toml",
        "length_unit = {}",
    ),
    "floor_origin.csv": (
        r"bounces at z = 0\.78 m, and must bounce at 0\.02 m, .*; set origin = (.*) in floor_origin\.toml",
        "origin = {}",
    ),
}
OTHERS = {"slow_backspin.csv", "serve.csv", "states_vector_cells.csv", "folder_one_bad"}


@pytest.fixture(autouse=True)
def _without_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def has_the_ball(track):
    """Check the bounce, within 5 ms and 10 mm."""
    (bounce,) = touches(track).bounces

    assert bounce.time == pytest.approx(BOUNCE[0], abs=5e-3)
    np.testing.assert_allclose(bounce.position[:2], BOUNCE[1], atol=0.01)


def test_every_file_has_its_test():
    files = {path.name for path in TRIALS.iterdir()} - {"README.md"}

    assert files == {*READ, *CURED, *OTHERS}


@pytest.mark.parametrize("name", READ)
def test_a_file_is_read_and_is_a_valid_rally(name):
    found = load(TRIALS / name)
    samples, dropped = READ[name]
    fitted = fit(found.tracks[0])

    assert found.dropped == dropped
    assert len(found.tracks[0].times) == samples
    has_the_ball(found.tracks[0])
    assert (fitted.samples, fitted.used_samples) == (samples, samples)
    assert of_fits([fitted]).valid.tolist() == [True]


@pytest.mark.parametrize("name", CURED)
def test_an_error_names_the_sidecar_that_cures_it(name, tmp_path):
    pattern, sidecar = CURED[name]
    copy = tmp_path / name
    copy.write_bytes((TRIALS / name).read_bytes())
    with pytest.raises(RecordingError, match=pattern) as caught:
        load(copy)
    words = str(caught.value)
    asked = re.search(pattern, words).group(1)
    copy.with_suffix(".toml").write_text(sidecar.format(asked))

    assert "\n" not in words
    has_the_ball(load(copy).tracks[0])


def test_a_slow_ball_with_backspin_is_fitted_and_its_spin_is_in_the_interval():
    fitted = fit(load(TRIALS / "slow_backspin.csv").tracks[0])
    low, high = fitted.spin_interval

    assert fitted.rms < 0.005
    assert low[1] < 200.0 < high[1]


@pytest.mark.parametrize("mode", ["launch", "kinematic"])
def test_a_serve_is_fitted_through_both_bounces_and_played_as_one(mode):
    path = TRIALS / "serve.csv"
    first, second = touches(load(path).tracks[0]).bounces
    found = read(Real2SimConfig(data=str(path), mode=mode), 1)
    fitted = found.fits[0]

    assert (first.time, second.time) == (pytest.approx(0.099, abs=5e-3), pytest.approx(0.539, abs=5e-3))
    np.testing.assert_allclose(first.position[:2], (1.005, 0.180), atol=0.01)
    np.testing.assert_allclose(second.position[:2], (-0.403, 0.100), atol=0.01)
    assert fitted.is_serve
    assert fitted.used_samples == fitted.samples == 170
    assert fitted.rms < 0.005
    assert found.rallies.launches[0, KIND] == SERVE
    assert found.rallies.valid.tolist() == [True]
    if mode == "kinematic":
        stages = found.rallies.paths[0, :, 6]
        assert [stages[0], stages[50], stages[-1]] == [4.0, 0.0, 1.0]


def test_cells_of_vectors_are_read():
    states = load(TRIALS / "states_vector_cells.csv").states

    np.testing.assert_array_equal(states.positions, [[1.2, 0.1, 0.25]])
    np.testing.assert_array_equal(states.velocities, [[-5.2, -0.3, 1.5]])
    np.testing.assert_array_equal(states.spins, [[0.0, -90.0, 20.0]])


def test_one_bad_file_does_not_end_a_folder(tmp_path, capsys):
    made = make_policy()
    save_policy(tmp_path / "policy", made.network, made.moments, made.contract)
    flags = ["--data", str(TRIALS / "folder_one_bad"), "--policy", str(tmp_path / "policy"), "--json"]

    assert command.main(flags, Event()) == DONE
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (found["recordings"], found["rallies"]) == (2, 2)
    assert list(found["skipped"]) == ["index.csv"]
    assert (found["samples"], found["used_samples"]) == (250, 250)
    with pytest.raises(ReportedError, match=r"index\.csv:1: no column x, y, z; got name, spin"):
        command.main([*flags, "--strict"], Event())
