"""The live page: a game, its clock, and the browser. One thread owns all of it; a tick is one picture."""

import contextlib
import io
import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import Final, cast

import viser
from viser.infra import WebsockClientConnection

from common.errors import ReportedError
from common.evaluation.rally_recorder import RecordedRally
from common.policy.contract import PolicyError
from common.service.run_folder import RunFolder
from common.task.config import PresetName
from topspin.render.replay import path_of
from topspin.render.scene import CameraName
from topspin.view import words
from topspin.view.ball import Judged, ball_of, judge
from topspin.view.cameras import Cameras
from topspin.view.config import ViewConfig
from topspin.view.curves import read_curves
from topspin.view.game import YOUR_BALL, Choice, Game, RobotChoice
from topspin.view.origin import is_loopback, is_own_page
from topspin.view.panel import Panel, Request
from topspin.view.picture import picture_at
from topspin.view.playback import Pace, Playback
from topspin.view.score import Score
from topspin.view.stage import Stage

log = logging.getLogger(__name__)

_TEXT_EVERY_S: Final = 0.2  # texts change slowly enough to be read
_CURVES_EVERY_S: Final = 5.0


class LocalServer(viser.ViserServer):
    """A server for its own page alone, at the address that was asked for."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port, verbose=False)
        server = self._websock_server  # viser itself asks for no origin, and has no setting for it

        async def refuse_other_sites(
            client: WebsockClientConnection,
        ) -> None:  # before anything is sent or read
            connection = server._live_connections[client.client_id]
            asked = connection.request.headers if connection.request is not None else {}
            origin = asked.get("Origin")
            if not is_own_page(origin, asked.get("Host", ""), is_loopback(host)):
                log.warning("a page of %s was refused; allowed: the page at http://%s:%d", origin, host, port)
                await connection.close(1008, "not a page of this server")

        server.on_client_connect(refuse_other_sites)
        server.disconnect_all_clients()  # those that were faster; a page connects again

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse: viser's share button would show the page to the internet, through a relay."""
        return None


class Page:
    """The page, served from its construction until it is closed; use it in a ``with``.

    Args:
        config: Its settings.
        port: A free port.
        run: The run that is followed; None: none.
    """

    def __init__(self, config: ViewConfig, port: int, run: RunFolder | None) -> None:
        self._run, self._game = run, Game(config, run)
        rally = self._game.next_ball()  # before the page is there: the first one may compile kernels
        with _quiet():
            self._server = LocalServer(config.host, port)
        self._cameras, self._stage = Cameras(self._server), Stage(self._server)
        choice, policies = self._game.choice, self._game.policies
        self._panel = Panel(self._server, choice, policies, config.slow, run is not None)
        self._score, self._pace = Score(), Pace()
        self._number = self._served = 0  # balls shown since the last choice; balls of the sliders
        self._text_due = self._curves_due = 0.0
        self._playback = Playback(0.0, speed=config.slow)
        self._joints = rally.joints[0]  # that are shown
        self._begin(rally)
        self._judge()

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        with _quiet():
            self._server.stop()

    def tick(self, now: float, passed: float) -> None:
        """Do what was asked for, and show the next picture.

        Args:
            now: Time [s] of a clock that never goes back.
            passed: Time since the last tick [s].
        """
        while not self._panel.requests.empty():
            self._do(self._panel.requests.get())
            self._text_due = now
        before = self._playback
        self._playback = before.after(passed)
        if before.time >= 0.0 and self._playback.time < before.end and not before.is_paused:
            self._pace = self._pace.after(self._playback.time - before.time, passed)
        if self._playback.is_over:
            self._next()
        self._show()
        if now >= self._text_due:
            self._text_due = now + _TEXT_EVERY_S
            playing = self._game.playing(YOUR_BALL if self._is_served else "")
            self._panel.show_status(
                words.status(playing, self._number, self._rally, self._playback, self._pace)
            )
        if self._run is not None and now >= self._curves_due:
            self._curves_due = now + _CURVES_EVERY_S
            self._panel.show_curves(read_curves(self._run))

    def _do(self, request: Request) -> None:
        match request.what:
            case "pause":
                self._pause(not self._playback.is_paused)
            case "next":
                self._next()
            case "slow":
                self._playback = replace(self._playback, speed=self._panel.speed)
            case "serve":
                self._serve()
            case "copy":
                rally = self._rally
                self._panel.show_ball(ball_of(rally.ball_pos[0], rally.ball_vel[0], rally.ball_spin[0]))
                self._judge()
            case "judge":
                self._judge()
            case "camera":
                self._cameras.look_from(cast(CameraName, request.value), request.client)
            case "policy" | "launch" | "robot":
                self._choose(chosen(self._game.choice, request))

    def _next(self) -> None:
        """Count the ball in play, and show the next one, by the newest policy."""
        if not self._is_served:
            self._score = self._score.with_rally(self._rally)
        try:
            if self._game.follow():
                log.info("policy=%s", self._game.playing().policy)
        except PolicyError as error:
            log.warning("the policy stays: %s", error)
        self._begin(self._game.next_ball())

    def _serve(self) -> None:
        """Show the sliders' ball; no rate counts it, since a person chose it."""
        judged = self._judge()
        if judged.block is not None:
            self._served += 1
            self._begin(self._game.play(judged.block), is_served=True)

    def _choose(self, choice: Choice) -> None:
        """Play on with another choice; the ball in play is not counted, and the score begins again."""
        if choice == self._game.choice or not self._panel.offers(choice):
            return
        try:
            self._game.choose(choice)
        except ReportedError as error:
            log.warning("%s", error)
            for client in self._server.get_clients().values():
                client.add_notification("Can't be played", str(error), color="red")
            self._panel.show_choice(self._game.choice)
            return
        self._score, self._number = Score(), 0
        self._begin(self._game.next_ball())
        self._judge()

    def _begin(self, rally: RecordedRally, is_served: bool = False) -> None:
        """Begin a ball's show."""
        self._rally, self._path, self._is_served = rally, path_of(rally), is_served
        self._number += 1
        self._stage.use_robot(rally.robot)
        self._playback = Playback(float(rally.time[-1]), speed=self._playback.speed)
        self._from = self._joints
        self._pause(False)
        self._panel.show_score(words.scoreboard(self._score))

    def _pause(self, is_paused: bool) -> None:
        self._playback = replace(self._playback, is_paused=is_paused)
        self._panel.show_pause(is_paused)

    def _judge(self) -> Judged:
        judged = judge(self._panel.ball, self._game.task, self._served + 1)
        self._panel.show_judgement(judged.text, judged.block is not None)
        return judged

    def _show(self) -> None:
        playback = self._playback
        picture = picture_at(self._rally, self._path, playback.time, self._from, playback.approach)
        self._stage.show(picture)
        self._joints = picture.joints
        self._cameras.follow(self._path, playback.time)


def chosen(choice: Choice, request: Request) -> Choice:
    """Return a choice with what is asked for."""
    match request.what:
        case "policy":
            return replace(choice, policy=request.value)
        case "launch":
            return replace(choice, launch=cast(PresetName, request.value))
        case _:
            return replace(choice, robot=cast(RobotChoice, request.value))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what viser prints off the terminal: the command says where the page is."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
