"""Reading recordings: round trips through every format, what is dropped and why, and every error text."""

import json
from pathlib import Path

import numpy as np
import pytest

from common.physics.flight import FULL
from tests.unit.topspin.real2sim.flights import launch_of, seen
from topspin.real2sim.fit.predict import predict
from topspin.real2sim.formats.ball_gun import FRAME as GUN_FRAME
from topspin.real2sim.formats.deepmind import COLUMNS
from topspin.real2sim.formats.deepmind import FRAME as DEEPMIND_FRAME
from topspin.real2sim.formats.recordings import load, load_folder
from topspin.real2sim.formats.tracks import RecordingError

h5py = pytest.importorskip("h5py", reason="h5py is missing: pip install -e '.[real2sim]'")

TRACK = seen(launch_of())
STATE = dict(zip(COLUMNS, (0.1, 1.2, 0.4, 0.5, -5.0, 1.5, 30.0, -4.0, 7.0), strict=True))


def write_hdf5(path, **recordings):
    with h5py.File(path, "w") as file:
        for name, (times, positions) in recordings.items():
            group = file.create_group(f"originals/{name}")
            group["time_stamps"], group["positions"] = times, positions
    return path


def write_json(path, *entries):
    path.write_text(json.dumps([{"id": k} | entry for k, entry in enumerate(entries)]))
    return path


def write_csv(path, header, rows, delimiter=";", sidecar=""):
    lines = [header, *(delimiter.join(repr(float(value)) for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    if sidecar:
        path.with_suffix(".toml").write_text(sidecar)
    return path


def rows_of(track):
    return np.column_stack([track.times, track.positions])


def in_file(frame, world):
    """Return positions in a file's frame: by the slow way, with a linear solver."""
    return np.linalg.solve(frame.rotation, (world / frame.length).T).T + frame.origin


# ---- round trips


def test_a_ball_guns_track_is_read_back(tmp_path):
    path = write_hdf5(
        tmp_path / "x_backspin.hdf5", **{"7": (TRACK.times + 3.0, in_file(GUN_FRAME, TRACK.positions))}
    )
    (track,) = load(path).tracks

    assert (track.id, track.label) == ("x_backspin/7", "backspin")
    np.testing.assert_allclose(track.times, TRACK.times, atol=1e-12)
    np.testing.assert_allclose(track.positions, TRACK.positions, atol=1e-12)


@pytest.mark.parametrize(
    ("header", "delimiter"), [("t;x;y;z", ";"), ("Timestamp,X,Y,Z", ","), ("time\tpos_x\tpos_y\tpos_z", "\t")]
)
def test_a_table_of_samples_is_read_back(tmp_path, header, delimiter):
    (track,) = load(write_csv(tmp_path / "throw.csv", header, rows_of(TRACK), delimiter)).tracks

    assert track.id == "throw"
    np.testing.assert_array_equal(track.times, TRACK.times)
    np.testing.assert_array_equal(track.positions, TRACK.positions)


def test_a_sidecar_gives_units_axes_origin_and_rate(tmp_path):
    # x of the world lies along -y of the file, which is in millimetres from a corner of the table, and in frames
    file_positions = 1e3 * np.column_stack(
        [TRACK.positions[:, 1] + 0.7625, 1.37 - TRACK.positions[:, 0], TRACK.positions[:, 2]]
    )
    rows = np.column_stack([np.arange(100, 100 + len(TRACK.times)), file_positions])
    sidecar = (
        'length_unit = "mm"\ntime_unit = "frame"\nrate_hz = 180.0\naxes = ["-y", "x", "z"]\n'
        'origin = [762.5, 1370.0, 0.0]\nlabel = "topspin"\n'
    )
    (track,) = load(write_csv(tmp_path / "throw.csv", "frame;x;y;z", rows, sidecar=sidecar)).tracks

    assert track.label == "topspin"
    np.testing.assert_allclose(track.times, TRACK.times, atol=1e-12)
    np.testing.assert_allclose(track.positions, TRACK.positions, atol=1e-12)


def test_a_rate_replaces_times(tmp_path):
    path = write_csv(tmp_path / "throw.csv", "x;y;z", TRACK.positions, sidecar="rate_hz = 180")

    np.testing.assert_allclose(load(path).tracks[0].times, TRACK.times, atol=1e-12)


def test_an_id_column_divides_a_table(tmp_path):
    lines = [
        f"{name},{row[0]},{row[1]},{row[2]},{row[3]}" for row in rows_of(TRACK) for name in ("left", "right")
    ]
    path = tmp_path / "two.csv"
    path.write_text("id,t,x,y,z\n# a comment\n\n" + "\n".join(lines))

    assert [track.id for track in load(path).tracks] == ["left", "right"]


def test_deepmind_states_are_read_in_the_world_frame(tmp_path):
    states = load(write_json(tmp_path / "rallies.json", STATE)).states

    # across to the right is the world's -y, along the table its x; spin is axial and turns like the others
    assert states.ids == ("0",)
    np.testing.assert_allclose(states.positions, [[1.2, -0.1, 0.4]])
    np.testing.assert_allclose(states.velocities, [[-5.0, -0.5, 1.5]])
    np.testing.assert_allclose(states.spins, [[-4.0, -30.0, 7.0]])


def test_topspin_stays_topspin_in_every_frame():
    """w x v of a topspin ball points down before and after a proper rotation."""
    for frame in (DEEPMIND_FRAME, GUN_FRAME):
        vel, spin = np.array([[0.3, -5.0, 0.2]]), np.array([[80.0, 10.0, -5.0]])
        lift = frame.rotation @ np.cross(spin, vel)[0]

        assert np.linalg.det(frame.rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(np.cross(frame.spins(spin), frame.velocities(vel))[0], lift, atol=1e-9)


def test_a_table_of_states_is_read_back(tmp_path):
    header = "x,y,z,vel_x,vel_y,vel_z,spin_x,spin_y,spin_z"
    row = (1.2, -0.1, 0.4, -5.0, -0.5, 1.5, 60.0, -120.0, 0.0)
    path = write_csv(tmp_path / "events.csv", header, [row], ",", 'spin_unit = "rpm"')
    states = load(path).states

    np.testing.assert_allclose(states.velocities, [row[3:6]])
    np.testing.assert_allclose(states.spins, [[2 * np.pi, -4 * np.pi, 0.0]])


def test_states_that_fly_away_are_dropped_or_turned(tmp_path):
    away = STATE | {"pos_y": -1.2, "vel_y": 5.0}
    path = write_json(tmp_path / "rallies.json", STATE, away)
    dropped, turned = load(path), load(path, turn=True)

    assert len(dropped.states) == 1
    assert dropped.dropped == {"state that flies away from the robot": 1}
    assert turned.dropped == {}
    # half a turn about z: x and y of all three vectors change sign
    np.testing.assert_allclose(turned.states.positions[1], [1.2, 0.1, 0.4])
    np.testing.assert_allclose(turned.states.velocities[1], [-5.0, 0.5, 1.5])
    np.testing.assert_allclose(turned.states.spins[1], [4.0, 30.0, 7.0])


def test_a_folders_sidecar_applies_to_files_without_their_own(tmp_path):
    for name in ("a", "b"):
        write_csv(tmp_path / f"{name}.csv", "t;x;y;z", rows_of(TRACK))
    (tmp_path / "folder.toml").write_text('label = "of the folder"')
    (tmp_path / "b.toml").write_text('label = "its own"')

    labels = [found.tracks[0].label for found in load_folder(tmp_path)]

    assert labels == ["of the folder", "its own"]


def test_a_sidecar_names_the_columns_of_a_file_without_names(tmp_path):
    rows = rows_of(TRACK)[:, [1, 2, 3, 0]]
    numbers = "\n".join(";".join(map(repr, map(float, row))) for row in rows)
    (tmp_path / "throw.toml").write_text('columns = ["x", "y", "z", "t"]')
    (tmp_path / "throw.csv").write_text(numbers)
    (track,) = load(tmp_path / "throw.csv").tracks

    np.testing.assert_array_equal(track.positions, TRACK.positions)
    np.testing.assert_array_equal(track.times, TRACK.times)

    (tmp_path / "throw.csv").write_text("a;b;c;d\n" + numbers)  # a first line with other names is replaced

    np.testing.assert_array_equal(load(tmp_path / "throw.csv").tracks[0].times, TRACK.times)


def test_units_of_the_header_win_over_the_sidecars(tmp_path):
    rows = rows_of(TRACK) * [1e3, 1e2, 1e2, 1e2]
    path = write_csv(
        tmp_path / "throw.csv", "t [ms];x (cm);y (cm);z (cm)", rows, sidecar='length_unit = "mm"'
    )
    (track,) = load(path).tracks

    np.testing.assert_allclose(track.times, TRACK.times, atol=1e-12)
    np.testing.assert_allclose(track.positions, TRACK.positions, atol=1e-12)


@pytest.mark.parametrize("has_decimal_comma", [True, False])
def test_numbers_may_have_a_decimal_comma(tmp_path, has_decimal_comma):
    path = write_csv(tmp_path / "throw.csv", "t;x;y;z", rows_of(TRACK))
    if has_decimal_comma:
        path.write_text(path.read_text().replace(".", ","))

    np.testing.assert_array_equal(load(path).tracks[0].positions, TRACK.positions)


@pytest.mark.parametrize("delay", [0.015, -0.015])
def test_a_velocity_of_another_moment_is_taken_back_to_the_positions(tmp_path, delay):
    launch = launch_of(vel=(-12.0, 0.5, 1.0), spin=(20.0, -300.0, 40.0))
    later = seen(launch, duration=2 * abs(delay), rate=1 / abs(delay))
    velocities = np.empty((2, 3))
    predict(launch, np.empty(0), FULL, later.times, np.empty((2, 3)), velocities)
    given, wanted = (velocities[1], launch[3:6]) if delay > 0 else (launch[3:6], velocities[1])
    row = [*launch[:3], *given, *launch[6:9]]
    path = write_csv(tmp_path / "s.csv", "x,y,z,vx,vy,vz,wx,wy,wz", [row], ",", f"velocity_delay_s = {delay}")

    # the acceleration of 40 m/s^2 changes by 4 % meanwhile
    np.testing.assert_allclose(load(path).states.velocities[0], wanted, atol=0.02)
    assert np.linalg.norm(given - wanted) > 0.3


@pytest.mark.parametrize("header", ["t,x,y,z", "t x y z", "Time; X [m]; Y [m]; Z [m]"])
@pytest.mark.parametrize("delimiter", [",", " ", ";"])
def test_a_header_that_numpy_writes_as_a_comment_names_the_columns(tmp_path, header, delimiter):
    np.savetxt(tmp_path / "throw.csv", rows_of(TRACK), delimiter=delimiter, header=f"by a camera\n{header}")
    (track,) = load(tmp_path / "throw.csv").tracks

    np.testing.assert_array_equal(rows_of(track), rows_of(TRACK))


@pytest.mark.parametrize("header", ["frame;t;x;y;z", "Frame;time;x;y;z"])
def test_a_column_frame_beside_a_time_is_a_counter(tmp_path, header):
    rows = np.column_stack([np.arange(len(TRACK.times)), rows_of(TRACK)])
    (track,) = load(write_csv(tmp_path / "throw.csv", header, rows)).tracks

    np.testing.assert_array_equal(rows_of(track), rows_of(TRACK))


# ---- frames that can't be the file's


def test_a_track_with_y_up_names_its_axes(tmp_path):
    rows = np.column_stack(
        [TRACK.times, -TRACK.positions[:, 0], TRACK.positions[:, 2], TRACK.positions[:, 1]]
    )
    path = write_csv(tmp_path / "throw.csv", "t;x;y;z", rows)

    with pytest.raises(
        RecordingError, match=r"flies along x, not -x and falls along -y, not -z; set axes = (.*) in"
    ):
        load(path)
    path.with_suffix(".toml").write_text('axes = ["-x", "z", "y"]')
    np.testing.assert_allclose(load(path).tracks[0].positions, TRACK.positions)


def test_states_that_fly_along_y_name_their_axes(tmp_path):
    row = (0.1, -1.2, 0.4, 0.5, 5.0, 1.5, 30.0, -4.0, 7.0)
    path = write_csv(tmp_path / "s.csv", "x,y,z,vx,vy,vz,wx,wy,wz", [row], ",")

    with pytest.raises(
        RecordingError, match=r'1 of 1 balls fly along y, not -x; set axes = \["-y", "x", "z"\] in s'
    ):
        load(path)


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ((1.0, 100.0), r"metres of this file look like centimetres .*; set length_unit = \"cm\" in t\.toml"),
        (
            (1e3, 1.0),
            r"times of this file look like ms \(a step of 5\.56 s\); set time_unit = \"ms\" in t\.toml",
        ),
        (
            (180.0, 1.0),
            r"times of this file look like frame numbers .*; set time_unit = \"frame\" and rate_hz",
        ),
    ],
)
def test_a_unit_that_is_not_the_files_is_named(tmp_path, factors, words):
    time, length = factors
    path = write_csv(tmp_path / "t.csv", "t;x;y;z", rows_of(TRACK) * [time, length, length, length])

    with pytest.raises(RecordingError, match=words):
        load(path)


def test_an_origin_at_the_tables_corner_is_said(tmp_path):
    rows = rows_of(TRACK) + np.array([0.0, 0.0, 1.5, 0.0])
    path = write_csv(tmp_path / "t.csv", "t;x;y;z", rows)

    with pytest.raises(
        RecordingError, match=r"bounces beside the table, at x = .* and y = 1\.5. m; set origin in t"
    ):
        load(path)


def test_a_ball_that_misses_the_table_and_bounces_on_the_floor_is_no_error(tmp_path):
    on_table = seen(launch_of())
    t = on_table.times
    fall = np.column_stack([t, 0.2 - 3.0 * t, 1.2 + 0.0 * t, 0.02 * np.ones_like(t)])
    fall[:, 3] += np.where(t < 0.39, -0.5 * 9.81 * t**2, -0.746 + 3.0 * (t - 0.39) - 4.905 * (t - 0.39) ** 2)
    path = write_csv(tmp_path / "t.csv", "t;x;y;z", fall)

    assert len(load(path).tracks) == 1


# ---- what is dropped


def put(rows, place, value):
    rows = rows.copy()
    rows[place] = value
    return rows


SAMPLES = {
    "sample that is not finite": lambda rows: put(rows, (20, 2), np.nan),
    "sample outside the room": lambda rows: put(rows, (20, 3), 30.0),
    "sample at the time of another": lambda rows: put(rows, (20, 0), rows[19, 0]),
    "sample far from both neighbours": lambda rows: put(rows, (20, 1), rows[20, 1] + 1.0),
}


@pytest.mark.parametrize("reason", SAMPLES)
def test_a_bad_sample_is_dropped_and_counted(tmp_path, reason):
    found = load(write_csv(tmp_path / "throw.csv", "t;x;y;z", SAMPLES[reason](rows_of(TRACK))))

    assert len(found.tracks[0].times) == len(TRACK.times) - 1
    assert [(name.startswith(reason), count) for name, count in found.dropped.items()] == [(True, 1)]


RECORDINGS = {
    "recording whose time goes backwards": lambda rows: put(rows, (20, 0), 0.0),
    "recording with fewer than 8 good samples": lambda rows: rows[:5],
    r"recording with more than 25% bad samples, most of them: sample that is not finite": lambda rows: put(
        rows, (slice(0, 60), 1), np.nan
    ),
    r"recording with more than 25% bad samples, most of them: sample outside the room .*check unit": (
        lambda rows: rows * [1.0, 1e3, 1e3, 1e3]
    ),
    "recording with a time step outside": lambda rows: rows * [1e3, 1.0, 1.0, 1.0],
    "recording with a speed outside": lambda rows: rows * [1.0, 1e-3, 1e-3, 1e-3],
}


@pytest.mark.parametrize("reason", RECORDINGS)
def test_a_bad_recording_is_dropped_and_a_good_one_beside_it_kept(tmp_path, reason):
    rows = RECORDINGS[reason](rows_of(TRACK))
    path = write_hdf5(
        tmp_path / "x.hdf5",
        **{
            "0": (rows[:, 0], in_file(GUN_FRAME, rows[:, 1:])),
            "1": (TRACK.times, in_file(GUN_FRAME, TRACK.positions)),
        },
    )
    found = load(path)

    assert [track.id for track in found.tracks] == ["x/1"]
    assert list(found.dropped.values()) == [1]
    with pytest.raises(RecordingError, match=rf"x\.hdf5: no recording is usable \({reason}"):
        load(write_hdf5(tmp_path / "x.hdf5", **{"0": (rows[:, 0], in_file(GUN_FRAME, rows[:, 1:]))}))


def test_a_long_gap_divides_a_recording(tmp_path):
    rows = np.delete(rows_of(TRACK), slice(40, 65), axis=0)
    found = load(write_csv(tmp_path / "throw.csv", "t;x;y;z", rows))

    assert [track.id for track in found.tracks] == ["throw-1", "throw-2"]
    assert [track.times[0] for track in found.tracks] == [0.0, 0.0]
    assert found.dropped == {"gap of more than 0.1 s, where a recording was divided": 1}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"vel_y": float("nan")}, "state that is not finite"),
        ({"pos_z": 20.0}, "state outside the room"),
        ({"vel_y": -70.0}, "state with a speed outside"),
        ({"w_vel_x": 3000.0}, "state with a spin above 2000 rad/s"),
    ],
)
def test_a_bad_state_is_dropped_and_counted(tmp_path, change, reason):
    found = load(write_json(tmp_path / "rallies.json", STATE, STATE | change))

    assert found.states.ids == ("0",)
    assert [(name.startswith(reason), count) for name, count in found.dropped.items()] == [(True, 1)]


# ---- errors

FILES = [
    ("none.csv", None, r"none\.csv: no such file"),
    ("x.csv", "", r"x\.csv: got an empty file"),
    ("x.csv", "# nothing but a comment\n", r"x\.csv: got an empty file; allowed: a line of column names"),
    ("x.xml", "<x/>", r"x\.xml: got a \.xml file; allowed: \.json, \.hdf5, \.h5, \.csv, \.txt"),
    ("x.csv", b"t;x;y;z\n\xff\xfe", r"x\.csv: not readable as text"),
    ("x.csv", "t;x;z\n0;1;2\n", r"x\.csv:1: no column y; got t, x, z"),
    (
        "x.csv",
        "0.0;1.0;2.0;3.0\n",
        r"x\.csv:1: got numbers, no column names; add the first line t;x;y;z \(or columns = \[\"t\", \"x\"",
    ),
    (
        "x.csv",
        "0.0,1.0\n",
        r"x\.csv:1: got numbers, no column names; add the first line t;x;y;z, or the names",
    ),
    ("x.csv", "t;x;y;z;time\n", r"x\.csv:1: 't' and 'time' are the same column"),
    ("x.csv", "t;x;y;z\n0;1;2\n", r"x\.csv:2: got 3 columns; allowed: 4"),
    ("x.csv", "t;x;y;z\n0;1;2;3\n1;1;abc;3\n", r"x\.csv:3: y: got 'abc'; allowed: a number"),
    ("x.csv", "t;x;y;z\n0,1;1.5;2;3\n", r"x\.csv:2: t: got '0,1'; allowed: a number"),
    ("x.csv", "t,x,y,z\n0,1,1,5,2,0,3,0\n", r"got 8 columns; allowed: 4 .* \(decimal commas need ; between"),
    ("x.csv", "t [h];x;y;z\n0;1;2;3\n", r"x\.csv:1: t \[h\]: got the unit 'h'; allowed: s, ms, us, ns"),
    (
        "x.csv",
        "pos;t\n[1 2 3];0\n[1 2];1\n",
        r"x\.csv:3: pos: got '\[1 2\]'; allowed: three numbers .* x, y, z",
    ),
    (
        "x.csv",
        "t;x;y;z\n".encode("utf-16-le"),
        r"x\.csv: not readable as text \(zero bytes\); allowed: UTF-8",
    ),
    ("x.csv", "x;y;z\n0;1;2\n", r"x\.csv: no column t, and no rate_hz in x\.toml"),
    ("x.csv", "t;x;y;z\n", r"x\.csv: no recording is usable \(there is none\)"),
    ("x.csv", "x;y;z;wx\n0;1;2;3\n", r"x\.csv: states need the columns vx, vy, vz, which are missing"),
    ("x.json", "[{", r"x\.json:1: not readable as JSON"),
    ("x.json", b"\xff\xff", r"x\.json: not readable as JSON"),
    ("x.json", "{}", r"x\.json: got a dict; allowed: a list of states"),
    ("x.json", "[3]", r"x\.json: entry 0: got 3; allowed: an object with id, pos_x"),
    ("x.json", '[{"id": 5, "pos_x": "far"}]', r"x\.json: id 5: pos_x: got 'far'; allowed: a number"),
    ("x.json", "[]", r"x\.json: no recording is usable \(there is none\)"),
    ("x.hdf5", "no HDF5 at all", r"x\.hdf5: not readable as HDF5"),
]


@pytest.mark.parametrize(("name", "content", "words"), FILES)
def test_a_file_that_cannot_be_read_is_one_line(tmp_path, name, content, words):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())

    with pytest.raises(RecordingError, match=words) as caught:
        load(path)
    assert "\n" not in str(caught.value)


SIDECARS = [
    ("lenght_unit = 'mm'", "unknown key 'lenght_unit'; allowed: kind, length_unit"),
    ("length_unit = 'inch'", "length_unit: got 'inch'; allowed: m, cm, mm"),
    ("time_unit = 'h'", "time_unit: got 'h'; allowed: s, ms, us, ns, frame"),
    ("spin_unit = 'hz'", "spin_unit: got 'hz'; allowed: rad/s, rps, rpm, deg/s"),
    ("kind = 'video'", "kind: got 'video'; allowed: track, states"),
    ("rate_hz = 0", "rate_hz: got 0; allowed: a number above 0"),
    ("rate_hz = true", "rate_hz: got True; allowed: a number above 0"),
    ("time_unit = 'frame'", "time_unit 'frame' needs rate_hz, which is missing"),
    ("player = 3", "player: got 3; allowed: a string"),
    ("columns = 't'", "columns: got 't'; allowed: a list such as"),
    ("velocity_delay_s = 15", "velocity_delay_s: got 15; allowed: -0.1 to 0.1"),
    ("label = 3", "label: got 3; allowed: a string"),
    ("axes = 'xyz'", "axes: got 'xyz'; allowed: a list such as"),
    ("axes = ['x', 'y', 'up']", "axes: got 'up'; allowed: x, y, z, -x, -y, -z"),
    ("axes = ['x', 'y', '-z']", "allowed: three different axes that make a rotation, no mirror image"),
    ("axes = ['x', 'y', 'y']", "allowed: three different axes that make a rotation, no mirror image"),
    ("origin = [0, 1]", r"origin: got \[0, 1\]; allowed: three numbers"),
    ("axes = [", "not readable as TOML"),
]


@pytest.mark.parametrize(("sidecar", "words"), SIDECARS)
def test_a_sidecar_that_cannot_be_used_is_one_line(tmp_path, sidecar, words):
    path = write_csv(tmp_path / "x.csv", "t;x;y;z", rows_of(TRACK), sidecar=sidecar)

    with pytest.raises(RecordingError, match=rf"x\.toml: .*{words}"):
        load(path)


def test_hdf5_without_what_is_needed_is_one_line(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["other"] = [1.0]
    with h5py.File(tmp_path / "b.hdf5", "w") as file:
        file["originals/0/positions"] = TRACK.positions
    with h5py.File(tmp_path / "c.hdf5", "w") as file:
        file["originals/0/positions"], file["originals/0/time_stamps"] = TRACK.positions[:, :2], TRACK.times
    with h5py.File(tmp_path / "d.hdf5", "w") as file:
        file["originals/0/positions"], file["originals/0/time_stamps"] = TRACK.positions, "noon"

    for name, words in (
        ("a", r"a\.hdf5: no group 'originals'; there are other"),
        ("b", r"b\.hdf5: originals/0: 'time_stamps' is missing; there are: positions"),
        ("c", r"c\.hdf5: originals/0: got times \(\d+,\) and positions \(\d+, 2\)"),
        ("d", r"d\.hdf5: originals/0: 'time_stamps': got no numbers"),
    ):
        with pytest.raises(RecordingError, match=words):
            load(tmp_path / f"{name}.hdf5")


def test_a_folder_is_read_by_name_and_must_hold_something(tmp_path):
    with pytest.raises(RecordingError, match=r"nowhere: no such folder"):
        load_folder(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"no recordings; allowed: files \*\.csv ending in \.json"):
        load_folder(tmp_path, "*.csv")
    for name in ("b", "a"):
        write_csv(tmp_path / f"{name}.csv", "t;x;y;z", rows_of(TRACK))

    assert [found.tracks[0].id for found in load_folder(tmp_path, "*.csv")] == ["a", "b"]


def test_a_file_that_may_not_be_read_is_one_bad_file_of_a_folder(tmp_path, monkeypatch):
    for name in ("a.csv", "b.csv"):
        write_csv(tmp_path / name, "t;x;y;z", rows_of(TRACK))
    read_bytes = Path.read_bytes

    def refuse(self):
        if self.name == "a.csv":
            raise PermissionError(13, "Permission denied", str(self))
        return read_bytes(self)

    monkeypatch.setattr(Path, "read_bytes", refuse)  # a test that runs as root may read everything
    skipped: dict[str, str] = {}

    assert len(load_folder(tmp_path, skipped=skipped)) == 1
    assert skipped == {"a.csv": f"{tmp_path / 'a.csv'}: Permission denied"}


# ---- what no recording may cost


def test_one_recording_in_other_units_does_not_cost_the_table(tmp_path):
    rows = [f"{k};" + ";".join(map(repr, map(float, row))) for k in range(10) for row in rows_of(TRACK)]
    slow = [
        f"slow;{0.7 * n};" + ";".join(map(repr, map(float, row[1:]))) for n, row in enumerate(rows_of(TRACK))
    ]
    path = tmp_path / "many.csv"
    path.write_text("\n".join(["id;t;x;y;z", *rows, *slow]))

    found = load(path)

    assert {track.id for track in found.tracks} == {f"{k}" for k in range(10)}
    assert sum(found.dropped.values()) >= 1


@pytest.mark.parametrize("cell", ["", "nan", "NA", "-", "null"])
def test_a_player_that_is_missing_is_nobody(tmp_path, cell):
    path = tmp_path / "events.csv"
    numbers = ";".join(map(repr, (1.2, -0.1, 0.4, -5.0, -0.5, 1.5, 60.0, -120.0, 0.0)))
    path.write_text(f"player;x;y;z;vx;vy;vz;wx;wy;wz\n{cell};{numbers}\nAnna;{numbers}\n")

    assert load(path).states.players == ("", "Anna")


def test_a_player_of_json_that_is_null_is_the_sidecars(tmp_path):
    path = write_json(tmp_path / "rallies.json", STATE | {"player": None}, STATE | {"player": "Anna"})
    path.with_suffix(".toml").write_text('player = "somebody"')

    assert load(path).states.players == ("somebody", "Anna")


def test_a_sidecars_key_without_effect_is_refused_unless_it_is_the_folders(tmp_path):
    states = write_json(tmp_path / "rallies.json", STATE)
    gun = write_hdf5(tmp_path / "gun.hdf5", **{"7": (TRACK.times, TRACK.positions)})
    for path in (states, gun):
        path.with_suffix(".toml").write_text('label = "drive"\nlength_unit = "mm"\n')

        with pytest.raises(
            RecordingError, match=rf"length_unit has no effect on a {path.suffix} file.*allowed: label"
        ):
            load(path)

        path.with_suffix(".toml").rename(tmp_path / "folder.toml")
        assert (load(path).states.labels or [track.label for track in load(path).tracks])[0] == "drive"
        (tmp_path / "folder.toml").unlink()


def test_a_field_of_text_without_an_end_is_one_line(tmp_path):
    path = tmp_path / "long.csv"
    path.write_text("t;x;y;z\n" + "1" * 200_000 + ";1;2;3\n")

    with pytest.raises(RecordingError, match=r"long.csv: not readable as a table: field larger than"):
        load(path)


def test_a_damaged_hdf5_is_one_line(tmp_path):
    path = write_hdf5(tmp_path / "gun.hdf5", **{"7": (TRACK.times, TRACK.positions)})
    with h5py.File(path, "a") as file:
        file["originals/8"] = h5py.SoftLink("/nowhere")

    with pytest.raises(RecordingError, match=r"gun.hdf5: not readable as HDF5: "):
        load(path)
