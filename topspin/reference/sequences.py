"""Sequence pictures: who sends what to whom, for one rally and for one policy version."""

from dataclasses import dataclass
from html import escape
from typing import Final, NamedTuple


class Arrow(NamedTuple):
    """One line of a sequence picture. An arrow from a service to itself is work of its own."""

    source: str
    target: str
    text: str


@dataclass(frozen=True, slots=True)
class Sequence:
    """One picture."""

    name: str
    title: str
    services: tuple[str, ...]  # from left to right
    arrows: tuple[Arrow, ...]  # from top to bottom


ONE_RALLY: Final = Sequence(
    "one_rally",
    "One rally, from its launch to the update that learns from it",
    ("generator", "actor", "learner"),
    (
        Arrow("generator", "generator", "draw a launch, fly it, keep it if valid"),
        Arrow("generator", "actor", "RallyBatch: 128 rallies of one shard"),
        Arrow("actor", "actor", "play: observe, act, step, reward"),
        Arrow("actor", "learner", "Rollout: 32 steps of all environments"),
        Arrow("learner", "learner", "admit, queue, write down its fate"),
        Arrow("learner", "actor", "Verdict and credits"),
        Arrow("learner", "learner", "advantages, PPO update"),
    ),
)
ONE_VERSION: Final = Sequence(
    "one_policy_version",
    "One policy version, from its update to its measure",
    ("learner", "actor", "evaluator"),
    (
        Arrow("learner", "learner", "update: version + 1"),
        Arrow("learner", "actor", "PolicySnapshot: weights, normalizer, stage"),
        Arrow("actor", "actor", "adopt it at the next block"),
        Arrow("actor", "learner", "ActorReport: has no credits"),
        Arrow("learner", "actor", "Verdict: credits for this version"),
        Arrow("actor", "learner", "Rollout with this version"),
        Arrow("learner", "actor", "Verdict: accepted or why not"),
        Arrow("evaluator", "learner", "policy? (every 45 s)"),
        Arrow("learner", "evaluator", "PolicySnapshot of the average weights"),
        Arrow("evaluator", "evaluator", "play 1,000 fixed rallies, keep the best"),
    ),
)
SEQUENCES: Final = (ONE_RALLY, ONE_VERSION)

_PITCH, _MARGIN, _HEAD, _ROW = 340, 130, 70, 48


def svg(sequence: Sequence) -> str:
    """Return the picture of one sequence."""
    places = {service: _MARGIN + _PITCH * index for index, service in enumerate(sequence.services)}
    width = 2 * _MARGIN + _PITCH * (len(places) - 1) + 200
    height = _HEAD + _ROW * len(sequence.arrows) + 40
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        f'font-size="14" role="img" aria-label="{escape(sequence.title)}">',
        '<defs><marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" '
        'orient="auto"><path d="M0 0 10 5 0 10z" fill="#444"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for service, x in places.items():
        lines += [
            f'<path d="M{x} 50V{height - 10}" stroke="#9fa8da" stroke-dasharray="4 4"/>',
            f'<rect x="{x - 60}" y="14" width="120" height="36" rx="8" fill="#e8eaf6" stroke="#3f51b5"/>',
            f'<text x="{x}" y="37" text-anchor="middle" font-weight="bold" fill="#1a237e">{service}</text>',
        ]
    for row, arrow in enumerate(sequence.arrows):
        lines += _arrow(arrow, places, _HEAD + 34 + _ROW * row)
    return "\n".join([*lines, "</svg>"]) + "\n"


def _arrow(arrow: Arrow, places: dict[str, int], y: int) -> list[str]:
    start, end = places[arrow.source], places[arrow.target]
    text = escape(arrow.text)
    if start == end:
        loop = f"M{start} {y - 18}h26v20h-22"
        return [_path(loop), f'<text x="{start + 34}" y="{y - 3}" font-size="13" fill="#444">{text}</text>']
    ahead = 6 if end > start else -6
    middle = (start + end) // 2
    return [
        _path(f"M{start} {y}H{end - ahead}"),
        f'<text x="{middle}" y="{y - 8}" text-anchor="middle" font-size="13" fill="#1a237e">{text}</text>',
    ]


def _path(path: str) -> str:
    return f'<path d="{path}" stroke="#444" stroke-width="1.5" fill="none" marker-end="url(#a)"/>'
