"""Picture of the trajectory states, made from the table `common.task.states.TRANSITIONS`."""

from collections import defaultdict
from typing import Final

from common.physics.touch import Touch
from common.task.states import CONTINUES_AS, TRANSITIONS, Outcome, State

MEANINGS: Final = {
    State.TAU_S0: "is served",
    State.TAU_01: "ball comes",
    State.TAU_12: "has bounced",
    State.TAU_23: "flies back",
    State.TAU_30: "has landed",
}
_WIDTH, _PITCH, _TOP, _ROW = 150, 280, 60, 20


def svg() -> str:
    """Return the picture: the states from left to right, and under each the touches that end the rally."""
    columns = list(TRANSITIONS)
    height = _TOP + 90 + _ROW * max(len(_endings(state)) for state in columns)
    width = 20 + _PITCH * (len(columns) - 1) + _WIDTH + 50
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        'font-size="14" role="img" aria-label="Trajectory states and outcomes">',
        '<defs><marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
        'orient="auto"><path d="M0 0 10 5 0 10z" fill="#444"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for index, state in enumerate(columns):
        lines += _state(state, 20 + _PITCH * index)
    for start, word in ((State.TAU_S, "serve"), (State.TAU_0, "stroke")):
        x = 20 + _PITCH * columns.index(CONTINUES_AS[start]) + _WIDTH // 2
        lines += [_arrow(f"M{x} 32V{_TOP - 2}"), _text(x, 22, f"{_name(start)}: {word}", "#444")]
    return "\n".join([*lines, "</svg>"]) + "\n"


def _state(state: State, left: int) -> list[str]:
    middle, below = left + _WIDTH // 2, _TOP + 60
    lines = [
        f'<rect x="{left}" y="{_TOP}" width="{_WIDTH}" height="60" rx="8" fill="#e8eaf6" stroke="#3f51b5"/>',
        _text(middle, _TOP + 26, _name(state), "#1a237e", bold=True),
        _text(middle, _TOP + 47, MEANINGS[state], "#1a237e"),
        _arrow(f"M{middle} {below}V{below + 24}"),
    ]
    for touch, following in TRANSITIONS[state].items():
        if isinstance(following, State) and touch is not Touch.NONE:
            right, gap = left + _WIDTH, left + (_WIDTH + _PITCH) // 2
            lines += [
                _arrow(f"M{right} {_TOP + 30}H{left + _PITCH - 2}"),
                _text(gap, _TOP + 20, f"{_name(following)}: {_word(touch)}", "#444", size=11),
            ]
            assert CONTINUES_AS[following] is list(TRANSITIONS)[list(TRANSITIONS).index(state) + 1]
    for row, ending in enumerate(_endings(state)):
        lines.append(_text(middle, below + 42 + _ROW * row, ending, "#b71c1c", size=12))
    return lines


def _endings(state: State) -> list[str]:
    """Return one line for each outcome of a state: the touches that lead to it."""
    touches = defaultdict(list)
    for touch, following in TRANSITIONS[state].items():
        if isinstance(following, Outcome):
            touches[following].append(_word(touch))
    every = len(TRANSITIONS[state]) - 1
    lines: list[str] = []
    for outcome, words in touches.items():
        if len(words) == every:
            lines.append(f"any touch: {outcome.name.lower()}")
            continue
        # three words fit on a line
        rows = [words[start : start + 3] for start in range(0, len(words), 3)]
        lines += [", ".join(row) + "," for row in rows[:-1]]
        lines.append(f"{', '.join(rows[-1])}: {outcome.name.lower()}")
    return lines


def _word(touch: Touch) -> str:
    return {Touch.ROBOT_COURT: "robot's court", Touch.OPPONENT_COURT: "opponent's court"}.get(
        touch, touch.name.lower()
    )


def _name(state: State) -> str:
    return state.name.lower()


def _text(x: int, y: int, text: str, color: str, *, bold: bool = False, size: int = 14) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x}" y="{y}" text-anchor="middle" font-size="{size}" fill="{color}"{weight}>{text}</text>'
    )


def _arrow(path: str) -> str:
    return f'<path d="{path}" stroke="#444" stroke-width="1.5" fill="none" marker-end="url(#a)"/>'
