"""The page's texts, as HTML: a function of the rally, the score and the pace."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from common.evaluation.rally_recorder import RecordedRally
from common.task.states import Outcome
from topspin.render.overlay import BAD_RGB, GOOD_RGB, OUTCOME_WORDS
from topspin.render.replay import spin_word
from topspin.render.scene import SPIN_RGB, TARGET_RGB, TRAIL
from topspin.view.curves import Curves
from topspin.view.picture import ESTIMATE_RGB, estimate_at, rgb8
from topspin.view.playback import Pace, Playback
from topspin.view.score import Score

Rgb = tuple[float, float, float]

_STYLE: Final = "font-size:0.86em;line-height:1.5;padding:0.2em 0.9em 0.5em;font-variant-numeric:tabular-nums"
_QUIET: Final = "opacity:0.68"


@dataclass(frozen=True, slots=True)
class Playing:
    """Who plays what."""

    policy: str
    robot: str
    trained_on: str  # robot of the policy's training
    balls: str  # launch preset, or "your ball"


def status(playing: Playing, number: int, rally: RecordedRally, playback: Playback, pace: Pace) -> str:
    """Return the text on the ball in play: its speed and spin, the robot's estimate, and how it ends."""
    k = max(int(np.searchsorted(rally.time, playback.time + 1e-9)) - 1, 0)
    speed, rate = np.linalg.norm(rally.ball_vel[k]), np.linalg.norm(rally.ball_spin[k])
    word = spin_word(rally.ball_vel[k], rally.ball_spin[k])
    believed = estimate_at(rally, playback.time)
    guess = f"{np.linalg.norm(believed.spin):.0f} rad/s" if believed is not None else "–"
    rows = [
        ("Speed", f"{speed:.1f} m/s"),
        ("Spin", f"{rate:.0f} rad/s, {word}"),
        ("Spin, robot's estimate", guess),
        ("Policy, robot", f"{playing.policy}, {playing.robot}"),
    ]
    note = ""
    if playing.robot != playing.trained_on:
        note = f"<div style='color:{css(BAD_RGB)}'>trained on {escape(playing.trained_on)}, not on this robot</div>"
    return (
        f"<div style='{_STYLE}'><div style='font-size:1.35em;font-weight:650'>Ball {number} "
        f"<span style='font-weight:400;{_QUIET}'>{escape(playing.balls)}</span></div>"
        f"{_verdict(rally, playback)}{_table(rows)}{note}<div style='{_QUIET}'>{pace_line(playback, pace)}</div></div>"
    )


def pace_line(playback: Playback, pace: Pace) -> str:
    """Return how fast the page plays."""
    if playback.is_paused:
        return "paused"
    asked = "" if playback.speed == 1.0 else f", slow motion {playback.speed:g} x"
    return f"plays at {pace.speed:.2f} x real time, {pace.rate_hz:.0f} pictures/s{asked}"


def _verdict(rally: RecordedRally, playback: Playback) -> str:
    """Return the outcome, once the ball shows it: a landing decides a return, and the ball flies on."""
    k = max(int(np.searchsorted(rally.time, playback.time + 1e-9)) - 1, 0)
    if playback.time < rally.time[-1] and rally.state[k] != 3:
        return f"<div style='{_QUIET}'>{TRAIL[int(rally.state[k])].label if playback.time >= 0 else 'next ball'}</div>"
    colour = GOOD_RGB if rally.outcome == Outcome.RETURNED else BAD_RGB
    return f"<div style='color:{css(colour)};font-weight:600'>{verdict(rally)}</div>"


def verdict(rally: RecordedRally) -> str:
    """Return the outcome in words."""
    words = OUTCOME_WORDS[rally.outcome]
    if np.isfinite(rally.landing_error):
        words += f", {100 * rally.landing_error:.0f} cm from the target"
    return words


def scoreboard(score: Score) -> str:
    """Return the rates so far, and the balls by outcome as bars."""
    if not score.balls:
        return f"<div style='{_STYLE};{_QUIET}'>no ball yet</div>"
    error = f"{100 * score.landing_error:.0f} cm" if score.returned else "–"
    rows = [
        ("Balls so far", str(score.balls)),
        ("Returned", f"{100 * score.return_rate:.0f} %"),
        ("Caught", f"{100 * score.catch_rate:.0f} %"),
        ("Mean distance to the target", error),
    ]
    bars = "".join(_bar(outcome, count, score.balls) for outcome, count in score.by_outcome())
    return f"<div style='{_STYLE}'>{_table(rows)}<div style='height:0.5em'></div>{bars}</div>"


def judgement(text: str, is_valid: bool) -> str:
    """Return whether a ball may be served, in its colour."""
    return f"<div style='{_STYLE};color:{css(GOOD_RGB if is_valid else BAD_RGB)}'>{escape(text)}</div>"


def progress(curves: Curves) -> str:
    """Return how far a training is."""
    newest = "no evaluation yet"
    if len(curves.minutes):
        newest = f"{curves.return_rate[-1]:.1f} % returned"
        if math.isfinite(error := curves.landing_error[-1]):  # nan: nothing has landed on the court
            newest += f", {error:.0f} cm from the target"
    rows = [
        ("Frames", f"{curves.frames / 1e6:.1f} M"),
        ("Stage", str(curves.stage or "–")),
        ("Newest evaluation", newest),
    ]
    return f"<div style='{_STYLE}'>{_table(rows)}</div>"


def legend() -> str:
    """Return what the colours mean."""
    signs = [(colour.rgb, colour.label) for colour in TRAIL.values()]
    signs += [(SPIN_RGB, "spin"), (ESTIMATE_RGB, "robot's estimate"), (TARGET_RGB, "target")]
    chips = "".join(
        f"<span style='white-space:nowrap;margin-right:0.9em'><span style='display:inline-block;width:1.1em;"
        f"height:0.45em;border-radius:0.2em;vertical-align:middle;outline:1px solid rgba(128,128,128,0.5);"
        f"background:{css(rgb)}'></span> {label}</span>"
        for rgb, label in signs
    )
    return f"<div style='{_STYLE}'>{chips}</div>"


def css(colour: Rgb) -> str:
    """Return a colour for a style."""
    return "rgb({},{},{})".format(*rgb8(colour))


def _bar(outcome: Outcome, count: int, balls: int) -> str:
    colour, share = css(GOOD_RGB if outcome == Outcome.RETURNED else BAD_RGB), 100.0 * count / balls
    return (
        f"<div style='display:flex;gap:0.5em;align-items:center'>"
        f"<span style='width:11em'>{OUTCOME_WORDS[outcome]}</span>"
        f"<span style='flex:1;height:0.55em;border-radius:0.3em;background:rgba(128,128,128,0.25)'><span "
        f"style='display:block;height:100%;border-radius:0.3em;width:{share:.1f}%;background:{colour}'></span></span>"
        f"<span style='width:2.6em;text-align:right'>{count}</span></div>"
    )


def _table(rows: Sequence[tuple[str, str]]) -> str:
    cells = "".join(
        f"<div style='display:flex;justify-content:space-between'><span style='{_QUIET}'>{escape(name)}</span>"
        f"<span>{escape(value)}</span></div>"
        for name, value in rows
    )
    return f"<div>{cells}</div>"
