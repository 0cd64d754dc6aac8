"""The panel beside the scene: texts, controls and curves. A control only asks; the loop does (``Request``)."""

from collections.abc import Sequence
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Final, Literal, get_args

import numpy as np
import viser
from viser import uplot

from common.task.config import RobotName
from common.task.launch_presets import PRESETS
from topspin.render.config import Camera
from topspin.view import words
from topspin.view.ball import SLIDERS, START, ServedBall
from topspin.view.curves import Curves
from topspin.view.game import Choice
from topspin.view.score import Score

What = Literal["pause", "next", "slow", "serve", "copy", "judge", "policy", "launch", "robot", "camera"]
TITLE: Final = "Topspin"
_SPEEDS: Final = (0.05, 1.0)  # [-] of real time
_ROBOTS: Final = ("contract", *get_args(RobotName))
_HINTS: Final[dict[What, str]] = {
    "launch": "kind of ball: a launch preset",
    "robot": "contract: the one that the policy was trained on",
    "policy": "a policy of the box, or the one that was given",
}
_CURVES: Final = (("return_rate", "returned, %", "#2fbf8f"), ("landing_error", "from target, cm", "#e8a33d"))


@dataclass(frozen=True, slots=True)
class Request:
    """What a person asks for."""

    what: What
    value: str = ""  # the choice
    client: int | None = None  # of whose tab the camera is


class Panel:
    """The controls, shared by all tabs.

    Args:
        server: The page's server.
        choice: What is chosen at first.
        policies: The policies to choose from, the first one first.
        slow: Speed at first [-] of real time.
        has_run: Whether a training is followed, so that there are curves.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        choice: Choice,
        policies: Sequence[str],
        slow: float,
        has_run: bool,
    ) -> None:
        self.requests: SimpleQueue[Request] = SimpleQueue()
        self._gui = server.gui
        self._gui.set_panel_label(TITLE)
        self._gui.configure_theme(
            dark_mode=True,
            show_logo=False,
            show_share_button=False,
            brand_color=(0, 150, 120),
            control_width="large",
        )
        self._gui.main_panel.dock_right()
        self._status = self._gui.add_html("")
        self._pause = self._button("Pause", "pause")
        self._button("Next ball", "next")
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Play"):
            self._add_choices(choice, policies, slow)
        with tabs.add_tab("Serve"):
            self._add_sliders()
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        if has_run:
            with tabs.add_tab("Training"):
                self._add_curves()

    @property
    def ball(self) -> ServedBall:
        """The ball of the sliders."""
        return ServedBall(*(_within(self._sliders[name], s.low, s.high) for name, s in SLIDERS.items()))

    @property
    def speed(self) -> float:
        """The speed of the flight [-] of real time."""
        return _within(self._speed, *_SPEEDS)

    def offers(self, choice: Choice) -> bool:
        """Return whether a choice is one of those that are offered: a browser can send anything."""
        return all(getattr(choice, name) in dropdown.options for name, dropdown in self._dropdowns.items())

    def show_ball(self, ball: ServedBall) -> None:
        """Set the sliders."""
        for name, slider in self._sliders.items():
            slider.value = getattr(ball, name)  # type: ignore[misc]  # mypy does not see viser's setter

    def show_status(self, text: str) -> None:
        """Show the text on the ball in play."""
        _change(self._status, text)

    def show_score(self, text: str) -> None:
        """Show the score."""
        _change(self._score, text)

    def show_judgement(self, text: str, is_valid: bool) -> None:
        """Show whether the sliders' ball may be served."""
        _change(self._judgement, words.judgement(text, is_valid))
        self._serve.disabled = not is_valid

    def show_pause(self, is_paused: bool) -> None:
        """Name the button for what it does next."""
        self._pause.label = "Go on" if is_paused else "Pause"

    def show_choice(self, choice: Choice) -> None:
        """Show what is chosen, where a choice was refused."""
        for name, dropdown in self._dropdowns.items():
            dropdown.value = getattr(choice, name)  # type: ignore[misc]  # as above

    def show_curves(self, curves: Curves) -> None:
        """Show how a training goes."""
        _change(self._progress, words.progress(curves))
        for name, plot in self._plots.items():
            plot.visible = len(curves.minutes) > 1
            plot.data = (curves.minutes, getattr(curves, name))

    def _ask(self, what: What, value: str = "", client: int | None = None) -> None:
        self.requests.put(Request(what, value, client))

    def _button(self, label: str, what: What) -> viser.GuiButtonHandle:
        button = self._gui.add_button(label)
        button.on_click(lambda _: self._ask(what))
        return button

    def _add_choices(self, choice: Choice, policies: Sequence[str], slow: float) -> None:
        cameras = self._gui.add_button_group("Camera", get_args(Camera))
        cameras.on_click(lambda event: self._ask("camera", event.target.value, event.client_id))
        self._speed = self._gui.add_slider(
            "Playback", *_SPEEDS, 0.05, slow, hint="speed of the flight; 1 is real time"
        )
        self._speed.on_update(lambda _: self._ask("slow"))
        self._dropdowns = {
            "launch": self._dropdown("Balls", "launch", tuple(PRESETS), choice.launch),
            "robot": self._dropdown("Robot", "robot", _ROBOTS, choice.robot),
            "policy": self._dropdown("Policy", "policy", policies, choice.policy),
        }
        self._score = self._gui.add_html(words.scoreboard(Score()))
        self._gui.add_html(words.legend())

    def _dropdown(
        self, label: str, what: What, names: Sequence[str], first: str
    ) -> viser.GuiDropdownHandle[str]:
        dropdown = self._gui.add_dropdown(label, names, initial_value=first, hint=_HINTS[what])
        dropdown.on_update(lambda _: self._ask(what, dropdown.value))
        return dropdown

    def _add_sliders(self) -> None:
        self._serve = self._button("Serve this ball", "serve")
        self._button("Copy the ball in play", "copy")
        self._judgement = self._gui.add_html("")
        self._sliders: dict[str, viser.GuiSliderHandle[float]] = {}
        for name, (label, unit, low, high, step, _, hint) in SLIDERS.items():
            slider = self._gui.add_slider(
                f"{label} [{unit}]", low, high, step, getattr(START, name), hint=hint
            )
            slider.on_update(lambda _: self._ask("judge"))
            self._sliders[name] = slider

    def _add_curves(self) -> None:
        self._progress = self._gui.add_html("")
        nothing = np.zeros(1)
        for name, label, colour in _CURVES:
            self._plots[name] = self._gui.add_uplot(
                (nothing, nothing),
                (
                    uplot.Series(label="minutes"),
                    uplot.Series(label=label, stroke=colour, width=2),
                ),
                scales={"x": uplot.Scale(time=False)},
                height=150,
                visible=False,
            )


def _within(slider: viser.GuiSliderHandle[float], low: float, high: float) -> float:
    """Return a slider's value, within its ends whatever a browser sends."""
    return min(max(float(slider.value), low), high)


def _change(handle: Any, text: str) -> None:
    """Set an HTML element's text if it is another one: nothing is sent for a text that stays."""
    if handle.content != text:
        handle.content = text
