"""`real2sim`: recordings of every format through the whole command, with a new policy."""

import json
import sys
from threading import Event

import numpy as np
import pytest

from common.errors import ConfigError, ReportedError, StoppedError
from common.physics.flight_model import Flight
from common.policy.folder import save_policy
from common.service.config import load
from common.service.process import DONE
from common.task.config import TaskConfig
from common.task.launch import DRAG_FACTOR, KIND, draw_rallies
from common.task.launch_presets import Kind
from tests.unit.evaluation.test_match import make_policy
from tests.unit.topspin.real2sim.flights import launch_of, seen
from topspin import real2sim
from topspin.real2sim import command
from topspin.real2sim.config import Real2SimConfig
from topspin.real2sim.dataset import NO_TRACK, SAME_NAME, TOO_SHORT, TRACK_AWAY, evenly, read
from topspin.real2sim.formats.deepmind import COLUMNS
from topspin.real2sim.formats.tracks import RecordingError
from topspin.real2sim.play import video_of
from topspin.real2sim.replay import seed_of


@pytest.fixture
def policy(tmp_path):
    made = make_policy()
    save_policy(tmp_path / "policy", made.network, made.moments, made.contract)
    return str(tmp_path / "policy")


def write_states(path, launches, away=0):
    """Write launches in DeepMind's frame: its x is the world's -y, its y the world's x; the last ``away`` turned."""
    entries = []
    for k, row in enumerate(np.asarray(launches)[:, :9].reshape(-1, 3, 3)):
        turned = row * [-1, -1, 1] if k >= len(launches) - away else row
        file = np.stack([-turned[:, 1], turned[:, 0], turned[:, 2]], axis=1).ravel()
        entries.append({"id": k} | dict(zip(COLUMNS, file.tolist(), strict=True)))
    path.write_text(json.dumps(entries))
    return path


def write_csv(path, *tracks):
    lines = ["id,t,x,y,z"]
    for k, track in enumerate(tracks):
        lines += [
            ",".join([f"t{k}", *(repr(float(v)) for v in (t, *p))])
            for t, p in zip(track.times, track.positions, strict=True)
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_hdf5(path, track):
    h5py = pytest.importorskip("h5py", reason="h5py is missing: pip install -e '.[real2sim]'")
    with h5py.File(path, "w") as file:
        group = file.create_group("originals/0")
        group["time_stamps"] = track.times
        # the gun's frame: rotated by 180 degrees, from its end of the table, above the floor
        group["positions"] = track.positions * [-1, -1, 1] + [1.37, 0.0, 0.739]
    return path


def run(capsys, *arguments):
    """Return what the command prints as its last line, and the lines before it."""
    assert command.main([*arguments, "--json"], Event()) == DONE
    *before, last = capsys.readouterr().out.splitlines()
    return json.loads(last), before


def settings(**values):
    return Real2SimConfig(**values)


def launches_of(*launches):
    """Return launches (n, 12) of recorded balls."""
    return np.array([np.append(launch, int(Kind.RECORDED)) for launch in launches])


COMING = launch_of(spin=(3.0, -45.0, 5.0))
INTO_NET = launch_of(vel=(-5.0, 0.0, 0.5))


def test_states_are_played_and_measured(policy, tmp_path, capsys):
    launches = np.vstack(
        [draw_rallies(6, TaskConfig(randomization="off"), seed=1).launches, launches_of(INTO_NET, COMING)]
    )
    data = write_states(tmp_path / "s.json", launches, away=1)
    found, before = run(capsys, "--data", str(data), "--policy", policy)

    assert before == []
    assert (found["recordings"], found["rallies"], found["valid_share"]) == (7, 6, round(6 / 7, 4))
    assert found["dropped"] == {"state that flies away from the robot": 1}
    assert (found["mode"], found["perception"], found["randomization"]) == ("launch", "full", "standard")
    assert sum(found["outcomes"].values()) == 6
    for name in ("catch_rate", "return_rate", "return_after_catch"):
        assert len(found[f"{name}_ci"]) == 2
    assert {"target_error_mean", "target_error_median", "seconds", "policy"} <= set(found)
    for kind in ("by_speed", "by_spin"):
        assert sum(entry["rallies"] for entry in found[kind]) == 6
    assert "fit_rms_median" not in found


@pytest.mark.parametrize("mode", ["launch", "kinematic"])
def test_tracks_of_any_format_are_fitted_and_played(policy, tmp_path, capsys, mode):
    folder = tmp_path / "recordings"
    folder.mkdir()
    write_csv(folder / "a.csv", seen(COMING, noise=1e-3), seen(launch_of(), noise=1e-3, seed=1))
    write_hdf5(folder / "topspin.hdf5", seen(COMING, noise=1e-3, seed=2))
    found, _ = run(capsys, "--data", str(folder), "--policy", policy, "--mode", mode)

    assert (found["recordings"], found["rallies"], found["tracks_fitted"]) == (3, 3, 3)
    assert 0.8e-3 < found["fit_rms_median"] < 2.5e-3  # a millimetre per axis
    assert found["mode"] == mode


@pytest.mark.parametrize("kind", ["states", "tracks"])
def test_the_same_command_gives_the_same_result_twice(policy, tmp_path, capsys, kind):
    if kind == "states":
        data = write_states(
            tmp_path / "s.json", draw_rallies(9, TaskConfig(randomization="off"), seed=2).launches
        )
    else:
        data = write_csv(tmp_path / "t.csv", *(seen(COMING, noise=1e-3, seed=k) for k in range(3)))
    first, _ = run(capsys, "--data", str(data), "--policy", policy, "--envs", "4")
    second, _ = run(capsys, "--data", str(data), "--policy", policy, "--envs", "4")

    assert first.pop("seconds") >= 0
    second.pop("seconds")
    assert first == second


def test_the_air_is_the_recordings_under_any_randomization(tmp_path):
    states = write_states(tmp_path / "s.json", [COMING])
    tracks = write_csv(tmp_path / "t.csv", seen(launch_of(drag=1.3, lift=1.0)))

    np.testing.assert_array_equal(
        read(settings(data=str(states)), Flight.FULL).rallies.launches[0, DRAG_FACTOR:KIND], [1.0, 1.0]
    )
    assert read(settings(data=str(tracks)), Flight.FULL).rallies.launches[0, 9] == pytest.approx(
        1.3, abs=0.05
    )


def test_a_recordings_seed_depends_on_its_name(tmp_path):
    data = write_states(tmp_path / "s.json", [COMING, launch_of()])
    found = read(settings(data=str(data)), Flight.FULL).rallies

    assert found.seeds.tolist() == [int(seed_of("0")), int(seed_of("1"))]


def test_recordings_of_one_name_are_distinguished_by_their_file(tmp_path):
    for name in ("a", "b"):
        write_states(tmp_path / f"{name}.json", [COMING, launch_of()])
    write_csv(tmp_path / "c.csv", seen(COMING))
    found = read(settings(data=str(tmp_path)), Flight.FULL)

    assert found.rallies.ids == ("0", "1", "b/0", "b/1", "t0")
    assert len(set(found.rallies.seeds.tolist())) == 5
    assert [track is None for track in found.tracks] == [True] * 4 + [False]
    assert np.isnan(found.fit_rms).tolist() == [True] * 4 + [False]


def test_recordings_without_a_name_are_played_or_counted(tmp_path):
    data = write_states(tmp_path / "s.json", [COMING, launch_of(), launch_of()])
    entries = json.loads(data.read_text())
    for entry in entries:
        entry["id"] = ""
    data.write_text(json.dumps(entries))
    found = read(settings(data=str(data)), Flight.FULL)

    assert found.rallies.ids == ("", "s/")
    assert found.dropped == {SAME_NAME: 1}


def test_a_repeated_name_in_a_file_is_dropped_and_counted(tmp_path):
    data = write_states(tmp_path / "s.json", [COMING, launch_of(), launch_of()])
    entries = json.loads(data.read_text())
    for entry in entries:
        entry["id"] = 7
    data.write_text(json.dumps(entries))
    found = read(settings(data=str(data)), Flight.FULL)

    assert found.rallies.ids == ("7", "s/7")
    assert found.dropped == {SAME_NAME: 1}


def test_tracks_that_leave_or_can_not_be_fitted_are_dropped_and_counted(tmp_path):
    leaving = seen(launch_of(pos=(-1.3, 0.0, 0.33), vel=(5.0, 0.1, 1.8)))
    hit = seen(COMING, duration=0.12)
    hit.positions[6:, 1] += 8.0 * (hit.times[6:] - hit.times[5])  # a stroke after six samples
    data = write_csv(tmp_path / "t.csv", seen(COMING), leaving, hit)
    found = read(settings(data=str(data)), Flight.FULL)

    assert found.rallies.ids == ("t0",)
    assert found.dropped == {TRACK_AWAY: 1, TOO_SHORT: 1}


def test_a_limit_takes_recordings_spread_evenly(tmp_path):
    data = write_states(
        tmp_path / "s.json", draw_rallies(10, TaskConfig(randomization="off"), seed=2).launches
    )

    assert read(settings(data=str(data), rallies=4), Flight.FULL).rallies.ids == ("0", "2", "5", "7")
    assert evenly(10, 0).tolist() == list(range(10))
    assert evenly(3, 10).tolist() == [0, 1, 2]
    assert evenly(0, 5).tolist() == []


def test_states_can_not_drive_a_ball(tmp_path):
    data = write_states(tmp_path / "s.json", [COMING])

    with pytest.raises(
        RecordingError, match="got states only, for --mode kinematic; allowed: tracks, or --mode"
    ):
        read(settings(data=str(data), mode="kinematic"), Flight.FULL)

    write_csv(tmp_path / "t.csv", seen(COMING))
    found = read(settings(data=str(tmp_path), mode="kinematic"), Flight.FULL)

    assert found.rallies.ids == ("t0",)
    assert found.dropped == {NO_TRACK: 1}


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("[{]", r"s\.json:1: not readable as JSON"),
        ("[]", r"s\.json: no recording is usable"),
        ('{"id": 1}', r"s\.json: got a dict; allowed: a list of states"),
    ],
)
def test_a_bad_file_is_one_line(policy, tmp_path, content, error):
    (tmp_path / "s.json").write_text(content)

    with pytest.raises(RecordingError, match=error) as raised:
        command.main(["--data", str(tmp_path / "s.json"), "--policy", policy], Event())
    assert "\n" not in str(raised.value)


def test_nothing_to_play_is_an_error_with_its_reason(policy, tmp_path, capsys):
    data = write_states(tmp_path / "s.json", [INTO_NET])

    with pytest.raises(
        RecordingError, match=r"got 1 recorded balls, none of which .* \(touches the net: 1\)"
    ):
        command.main(["--data", str(data), "--policy", policy], Event())
    with pytest.raises(RecordingError, match="touches the net: 1"):
        command.main(["--data", str(data), "--policy", policy, "--json"], Event())
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (found["rallies"], found["recordings"], found["invalid"]) == (0, 1, {"touches the net": 1})
    with pytest.raises(RecordingError, match=r"gone\.csv: no such file"):
        command.main(["--data", str(tmp_path / "gone.csv"), "--policy", policy], Event())
    with pytest.raises(ConfigError, match=r"no recordings to play; give some with .* --data FILE_OR_FOLDER"):
        command.main(["--policy", policy], Event())


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (["--mode", "fly"], r"real2sim.mode = 'fly' \(--mode\); allowed: launch, kinematic"),
        (["--video", "a.avi"], r"real2sim.video = 'a.avi' \(--video\); allowed: text, matching"),
        (["--dta", "x"], "unknown flag --dta; did you mean '--data'"),
    ],
)
def test_a_bad_setting_is_one_line_that_says_what_is_allowed(flags, line):
    with pytest.raises(ConfigError, match=line):
        load(Real2SimConfig, flags, prog="p", section="real2sim", environ={})


def test_a_film_is_made_on_request():
    assert video_of(settings()) is None
    assert str(video_of(settings(out="o"))) == "o/rallies.mp4"
    assert str(video_of(settings(out="o", video="v.mp4"))) == "v.mp4"
    assert video_of(settings(out="o", film_rallies=0)) is None


def test_without_its_libraries_a_report_names_the_extra(policy, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "topspin.real2sim.page", None)
    monkeypatch.delattr(real2sim, "page", raising=False)
    flags = ["--data", str(tmp_path / "gone.json"), "--policy", policy, "--out", str(tmp_path / "o")]

    with pytest.raises(ReportedError, match=r"pip install -e '\.\[report\]'"):
        command.main(flags, Event())  # raised before the recordings are read


def test_it_stops_on_request(policy, tmp_path):
    data = write_states(tmp_path / "s.json", [COMING])
    stop = Event()
    stop.set()

    with pytest.raises(StoppedError, match="stopped before it was done"):
        command.main(["--data", str(data), "--policy", policy], stop)


def test_the_report_holds_tables_and_plots(policy, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="matplotlib is missing: pip install -e '.[report]'")
    pytest.importorskip("jinja2", reason="jinja2 is missing: pip install -e '.[report]'")
    write_states(tmp_path / "s.json", draw_rallies(3, TaskConfig(randomization="off"), seed=2).launches)
    write_csv(tmp_path / "t.csv", seen(COMING, noise=1e-3))
    out = tmp_path / "report"
    flags = f"--data {tmp_path} --policy {policy} --out {out} --film-rallies 0 --shown 4"
    found, _ = run(capsys, *flags.split())

    page = (out / "report.md").read_text()
    assert found["report"] == str(out / "report.md")
    assert json.loads((out / "results.json").read_text())["rallies"] == 4
    for name in ("rates", "landings", *(f"flight_{k}" for k in range(1, 5))):
        assert f"({name}.png)" in page
        assert (out / f"{name}.png").stat().st_size > 10_000
    assert page.startswith("# Topspin: recorded balls\n")
    assert "fit of 1 tracks" in page
    assert (out / "report.html").read_text().count("data:image/png") == 6
