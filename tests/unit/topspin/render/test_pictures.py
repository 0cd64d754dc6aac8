import ctypes.util
from dataclasses import replace
from typing import get_args

import mujoco
import numpy as np
import pytest

from common.robot.model import load_model
from common.task.states import Outcome, State
from tests.unit.topspin.render.recorded import make_moment, make_rally, make_recorded
from topspin.render.film import FilmOptions, picture_count, pictures, write_film
from topspin.render.gl import RenderError, wanted
from topspin.render.hall import load_hall
from topspin.render.overlay import OUTCOME_WORDS, Lettering, ScoreCard
from topspin.render.replay import BallPath
from topspin.render.scene import CAMERAS, TARGET_RGB, TRAIL, Camera, CameraName, Painter
from topspin.render.stills import rally_picture, rally_strip, save_png, showpiece

SIZE = (320, 180)


@pytest.fixture(scope="module", autouse=True)
def _libraries():
    for module in ("PIL", "imageio_ffmpeg"):
        pytest.importorskip(module, reason=f"{module} is missing: pip install -e '.[report]'")


@pytest.fixture(scope="module")
def painter():
    try:
        painter = Painter(*SIZE)
    except RenderError as error:
        pytest.skip(f"no OpenGL here: {error}")
    with painter:
        yield painter


def nearest(colours, pixel):
    """Return which colour in [0, 1] has the pixel's hue: the smallest angle between them."""
    pixel = pixel / np.linalg.norm(pixel)
    return max(colours, key=lambda key: pixel @ np.array(colours[key]) / np.linalg.norm(colours[key]))


def test_every_state_outcome_and_camera_has_an_entry():
    assert set(TRAIL) == {state // 2 for state in State}
    assert len({colour.rgb for colour in TRAIL.values()}) == len({c.label for c in TRAIL.values()}) == 5
    assert set(OUTCOME_WORDS) == set(Outcome)
    assert set(CAMERAS) == set(get_args(CameraName))


def test_the_drawn_robot_has_the_pose_of_the_trained_one():
    drawn, trained = load_hall(), load_model()
    rng = np.random.default_rng(0)
    for _ in range(5):
        joints = rng.uniform(trained.jnt_range[:, 0], trained.jnt_range[:, 1])
        poses = []
        for model in (drawn, trained):
            data = mujoco.MjData(model)
            data.qpos[:7] = joints
            mujoco.mj_kinematics(model, data)
            poses.append(data.body("racket").xmat.copy())
            poses.append(data.body("racket").xpos.copy())

        np.testing.assert_allclose(poses[0], poses[2], atol=1e-12)
        np.testing.assert_allclose(poses[1], poses[3], atol=1e-12)


def test_the_ball_is_where_it_projects_to(painter):
    ball = np.array([0.3, 0.1, 0.4])
    camera = Camera((0.3, 0.1, 0.43), 0.6, 101.0, -18.0)  # the ball stands below the picture's middle
    shown = painter.paint(make_moment(ball_pos=ball), camera)
    (column, row) = painter.project(ball[None])[0].round().astype(int)
    gone = painter.paint(make_moment(ball_pos=ball + np.array([0.0, 0.0, 5.0])), camera)

    assert row > SIZE[1] / 2 + 5
    pixel = shown[row, column].astype(int)
    assert pixel[0] > 150  # white or orange
    assert np.abs(pixel - gone[row, column]).max() > 60
    changed = np.argwhere(np.abs(shown.astype(int) - gone).max(axis=2) > 60).mean(axis=0)
    np.testing.assert_allclose(changed, [row, column], atol=3)


@pytest.mark.parametrize("state", TRAIL)
def test_the_trail_has_its_states_colour(painter, state):
    points = np.array([[0.2, -0.1, 0.5], [0.5, 0.1, 0.5]])
    trail = BallPath(np.array([0.0, 0.1]), points, np.full(2, state))
    camera = Camera((0.35, 0.0, 0.5), 0.8, 101.0, -18.0)

    picture = painter.paint(make_moment(trail=trail), camera)

    column, row = painter.project(points.mean(axis=0)[None])[0].round().astype(int)
    assert nearest({key: colour.rgb for key, colour in TRAIL.items()}, picture[row, column]) == state


def test_the_target_is_a_disc_with_a_white_ring(painter):
    target = np.array([0.6, -0.2])
    camera = Camera((0.6, -0.2, 0.0), 1.0, 101.0, -50.0)
    shown = painter.paint(make_moment(target=target), camera)
    places = painter.project(np.array([[0.6, -0.2, 0.004], [0.6, -0.26, 0.003]])).round().astype(int)
    gone = painter.paint(make_moment(target=-target), camera)

    middle, ring = (shown[row, column].astype(int) for column, row in places)
    assert middle[1] == middle.max()
    assert TARGET_RGB[1] == max(TARGET_RGB)
    assert ring.min() > 180
    assert gone[places[0, 1], places[0, 0]].argmax() == 2  # the table is blue


@pytest.mark.parametrize("name", sorted(set(CAMERAS) - {"follow"}))
def test_a_picture_shows_all_of_the_table(painter, name):
    picture = painter.paint(make_moment(), CAMERAS[name])

    corners = np.array([[x, y, 0.0] for x in (-1.37, 1.37) for y in (-0.7625, 0.7625)])
    assert ((painter.project(corners) > 0) & (painter.project(corners) < SIZE)).all()
    assert picture.std() > 15


def test_ghosts_are_faint_and_only_of_the_arm(painter):
    other = make_moment().joints + np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    alone = painter.paint(make_moment(), CAMERAS["side"]).astype(int)
    haunted = painter.paint(make_moment(ghosts=(other,)), CAMERAS["side"]).astype(int)
    there = painter.paint(make_moment(joints=other), CAMERAS["side"]).astype(int)

    ghost, robot = np.abs(haunted - alone).max(axis=2), np.abs(there - alone).max(axis=2)
    assert 0 < (ghost > 8).sum() < (robot > 8).sum()
    assert ghost.max() < robot.max()


def test_a_score_card_is_written_over_a_darker_picture():
    picture = np.full((180, 320, 3), 200, np.uint8)
    bars = (("returned", 9, True), ("missed", 1, False))

    card = Lettering(180).write_card(picture, ScoreCard("default", (("returned", "90 %"),), bars)).astype(int)

    assert card[0, 0].max() < 100
    green, orange = (card[..., 1] - card[..., 0] > 60, card[..., 0] - card[..., 2] > 60)
    assert green.sum() > 5 * orange.sum() > 0  # bars as long as the balls are many


@pytest.mark.usefixtures("painter")
def test_a_film_is_h264_of_the_expected_length_and_size(tmp_path):
    ffmpeg = wanted("imageio_ffmpeg")
    rallies = [make_rally(), replace(make_rally(6), outcome=Outcome.RETURNED, landing_error=0.1)]
    options = FilmOptions(320, 180, slow=0.5, note="test")
    path = tmp_path / "new folder" / "play.mp4"

    card = ScoreCard(
        "default: 2 balls", (("returned", "50.0 %"),), (("returned", 1, True), ("missed", 1, False))
    )

    count = write_film(path, pictures(rallies, options, card), 320, 180, options.rate_hz)

    frames, seconds = ffmpeg.count_frames_and_secs(str(path))
    reader = ffmpeg.read_frames(str(path))
    about = next(reader)
    reader.close()
    assert frames == count == picture_count(rallies, options, card)
    assert seconds == pytest.approx(count / 50.0, abs=0.02)
    assert about["codec"] == "h264"
    assert about["size"] == (320, 180)
    assert about["pix_fmt"].startswith("yuv420p")
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # a browser can start before it has the whole file
    assert list(path.parent.iterdir()) == [path]


def test_a_film_that_fails_leaves_nothing_behind(tmp_path):
    def broken():
        yield np.zeros((180, 320, 3), np.uint8)
        raise RenderError("out of film")

    with pytest.raises(RenderError, match="out of film"):
        write_film(tmp_path / "play.mp4", broken(), 320, 180, 50.0)

    assert list(tmp_path.iterdir()) == []


def test_a_film_that_cant_be_written_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")

    with pytest.raises(RenderError, match=r"can't write .*play.mp4: .*File exists"):
        write_film(tmp_path / "file" / "play.mp4", [], 320, 180, 50.0)


@pytest.mark.usefixtures("painter")
def test_stills_are_small_files(tmp_path):
    rally = showpiece(make_recorded(6))
    for name, picture, width in (
        ("rally.png", rally_picture(rally, "side", 640, 360), 640),
        ("strip.png", rally_strip(rally, 160, 120), None),
    ):
        save_png(tmp_path / name, picture)

        assert (tmp_path / name).stat().st_size < 300_000
        assert picture.std() > 15
        assert width in (None, picture.shape[1])


def test_the_showpiece_is_the_return_that_lands_nearest():
    far, near = (replace(make_rally(), outcome=Outcome.RETURNED, landing_error=e) for e in (0.3, 0.1))

    assert showpiece([make_rally(), far, near]) is near


def test_a_context_that_draws_nothing_is_one_line(monkeypatch):
    def fail(*_given):
        raise mujoco.FatalError("gladLoadGL error")

    monkeypatch.setattr(mujoco, "MjrContext", fail)

    with pytest.raises(RenderError, match=r"^nothing can be drawn: gladLoadGL error; .* unset MUJOCO_GL$"):
        Painter(64, 64)


def test_a_missing_library_is_named_with_the_fix(monkeypatch):
    with pytest.raises(RenderError, match=r"pictures need no_such_library.*pip install -e '\.\[report\]'"):
        wanted("no_such_library")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    with pytest.raises(RenderError, match=r"neither libEGL nor libOSMesa is here; .*apt-get install"):
        Painter(64, 64)
