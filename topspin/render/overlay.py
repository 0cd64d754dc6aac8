"""The text on a picture: rally, outcome, speed, spin, and a legend of the trail's colours."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from common.task.states import Outcome
from topspin.render.gl import Image, wanted
from topspin.render.scene import SPIN_RGB, TRAIL

Rgb = tuple[float, float, float]

OUTCOME_WORDS: Final[dict[Outcome, str]] = {
    Outcome.NONE: "",
    Outcome.RETURNED: "returned",
    Outcome.NET: "into the net",
    Outcome.OUT: "past the table",
    Outcome.OWN_COURT: "onto its own court",
    Outcome.EDGE: "onto an edge",
    Outcome.DOUBLE_HIT: "hit twice",
    Outcome.BODY: "touched with the arm",
    Outcome.VOLLEY: "hit before it bounced",
    Outcome.DOUBLE_BOUNCE: "bounced twice",
    Outcome.MISS: "missed",
    Outcome.BAD_LAUNCH: "a bad launch",
    Outcome.TIME_OUT: "out of time",
}
GOOD_RGB: Final = (0.25, 0.85, 0.60)
BAD_RGB: Final = (0.98, 0.55, 0.25)
_TEXT, _QUIET, _PANEL = (245, 247, 250, 255), (188, 196, 208, 255), (12, 15, 22, 165)
_MARGIN, _PAD, _CORNER = 24, 16, 10  # [pixels] at 720 lines; all sizes follow the picture's height


@dataclass(frozen=True, slots=True)
class Caption:
    """The text on one picture."""

    title: str = ""
    lines: tuple[str, ...] = ()
    verdict: str = ""  # the outcome, after the rally's end
    is_good: bool = True  # decides the verdict's colour
    note: str = ""  # small, bottom right: which balls, slow motion
    legend: bool = True


@dataclass(frozen=True, slots=True)
class ScoreCard:
    """The last picture of a film: what was measured."""

    title: str  # policy and balls
    rows: tuple[tuple[str, str], ...]  # name and value
    bars: tuple[tuple[str, int, bool], ...]  # outcome, balls, whether it is the good one


def rgb8(colour: Rgb) -> tuple[int, int, int, int]:
    """Return a colour in [0, 1] as bytes, opaque."""
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue, 255


class Lettering:
    """Writes captions on pictures of one height; keeps its fonts.

    Args:
        height: Of the pictures [pixels].
    """

    def __init__(self, height: int) -> None:
        self._image, self._draw = wanted("PIL.Image"), wanted("PIL.ImageDraw")
        font = wanted("PIL.ImageFont")
        self._unit = height / 720.0
        self._large, self._medium, self._small = (font.load_default(self._px(s)) for s in (30, 20, 17))

    def write(self, picture: Image, caption: Caption) -> Image:
        """Return the picture with its caption."""
        image = self._image.fromarray(picture)
        draw = self._draw.Draw(image, "RGBA")
        width, height = image.size
        margin = self._px(_MARGIN)
        if caption.title:
            self._title(draw, margin, caption)
        if caption.note:
            self._pill(draw, caption.note, self._small, _QUIET, right=width - margin, bottom=height - margin)
        if caption.verdict:
            colour = rgb8(GOOD_RGB if caption.is_good else BAD_RGB)
            self._pill(draw, caption.verdict, self._large, colour, centre=width // 2, top=margin)
        if caption.legend:
            self._legend(draw, margin, height - margin)
        written: npt.NDArray[np.uint8] = np.asarray(image)
        return written

    def write_card(self, picture: Image, card: ScoreCard) -> Image:
        """Return the picture, darkened, with a score card in its middle."""
        image = self._image.fromarray((0.35 * picture).astype(np.uint8))
        draw = self._draw.Draw(image, "RGBA")
        width, height = image.size
        wide, pad, step = self._px(620), self._px(28), self._px(30)
        lines = len(card.rows) + len(card.bars)
        high = 2 * pad + self._px(52) + lines * step + self._px(14)
        left, y = (width - wide) / 2, (height - high) / 2
        self._panel(draw, (left, y, left + wide, y + high))
        left, right, y = left + pad, left + wide - pad, y + pad
        draw.text((left, y), card.title, _TEXT, self._large)
        y += self._px(52)
        for name, value in card.rows:
            draw.text((left, y), name, _QUIET, self._medium)
            draw.text((right, y), value, _TEXT, self._medium, anchor="ra")
            y += step
        y += self._px(14)
        balls = max(sum(count for _, count, _ in card.bars), 1)
        start, most = left + self._px(230), right - self._px(70)
        for name, count, is_good in card.bars:
            draw.text((left, y), name, _TEXT, self._small)
            middle, end = y + self._px(10), start + max((most - start) * count / balls, self._px(4))
            colour = rgb8(GOOD_RGB if is_good else BAD_RGB)
            draw.rounded_rectangle(
                (start, middle - self._px(5), end, middle + self._px(5)), self._px(5), colour
            )
            draw.text((right, y), str(count), _TEXT, self._small, anchor="ra")
            y += step
        written: npt.NDArray[np.uint8] = np.asarray(image)
        return written

    def _px(self, size: float) -> int:
        return max(round(size * self._unit), 1)

    def _title(self, draw: Any, margin: int, caption: Caption) -> None:
        pad = self._px(_PAD)
        rows = [(caption.title, self._large, _TEXT, self._px(40))]
        rows += [(line, self._medium, _QUIET, self._px(27)) for line in caption.lines]
        wide = max(draw.textlength(text, font) for text, font, _, _ in rows)
        # as wide as its longest possible line, so that the width does not change with the digits
        wide = max(wide, self._px(290))
        self._panel(
            draw, (margin, margin, margin + wide + 2 * pad, margin + sum(r[3] for r in rows) + pad * 1.4)
        )
        y = margin + pad * 0.7
        for text, font, colour, step in rows:
            draw.text((margin + pad, y), text, colour, font)
            y += step

    def _pill(
        self,
        draw: Any,
        text: str,
        font: Any,
        colour: tuple[int, int, int, int],
        *,
        top: int | None = None,
        bottom: int = 0,
        right: int | None = None,
        centre: int = 0,
    ) -> None:
        pad = self._px(_PAD)
        left, up, end, down = draw.textbbox((0, 0), text, font)
        wide, high = end - left, down - up
        x = right - wide - 2 * pad if right is not None else centre - wide // 2 - pad
        y = top if top is not None else bottom - high - 1.5 * pad
        self._panel(draw, (x, y, x + wide + 2 * pad, y + high + 1.5 * pad))
        draw.text((x + pad - left, y + 0.75 * pad - up), text, colour, font)

    def _legend(self, draw: Any, margin: int, bottom: int) -> None:
        pad, gap, bar = self._px(_PAD), self._px(26), self._px(26)
        labels = [(rgb8(colour.rgb), colour.label) for colour in TRAIL.values()]
        labels.append((rgb8(SPIN_RGB), "axis of spin"))
        wide = sum(bar + self._px(8) + draw.textlength(label, self._small) for _, label in labels)
        wide += gap * (len(labels) - 1)
        high = self._px(36)
        self._panel(draw, (margin, bottom - high, margin + wide + 2 * pad, bottom))
        x, middle = margin + pad, bottom - high / 2
        for colour, label in labels:
            draw.rounded_rectangle(
                (x, middle - self._px(3), x + bar, middle + self._px(3)), self._px(3), colour
            )
            x += bar + self._px(8)
            draw.text((x, middle), label, _TEXT, self._small, anchor="lm")
            x += draw.textlength(label, self._small) + gap

    def _panel(self, draw: Any, box: tuple[float, float, float, float]) -> None:
        draw.rounded_rectangle(box, self._px(_CORNER), _PANEL)
