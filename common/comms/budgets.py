"""What one message may cost its receiver: one table, which the decoder applies before it builds any object.

Memory of a decoded message is at most its bytes, and 256 bytes for each item: a number, text, array or map of msgpack.
So the largest, a rollout, takes 64 MiB and 1 MiB; a control message takes 64 KiB and 1 MiB. An array of numbers is one
item.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

KIB: Final = 1024
MIB: Final = 1024 * KIB
LARGEST: Final = 64 * MIB  # [bytes] of any message


@dataclass(frozen=True, slots=True)
class Budget:
    """The size of one kind of message."""

    bytes: int
    items: int


CONTROL: Final = Budget(64 * KIB, 4096)

BUDGETS: Final[Mapping[str, Budget]] = MappingProxyType(
    {
        "Rollout": Budget(LARGEST, 4096),
        "PolicySnapshot": Budget(LARGEST, 256),
        "RallyBatch": Budget(4 * MIB, 256),
        "RallyRequest": CONTROL,
        "StageChange": CONTROL,
        "StageLog": CONTROL,
        "Verdict": CONTROL,
        "ActorReport": CONTROL,
        "JoinRequest": CONTROL,
        "Place": CONTROL,
        "Status": CONTROL,
        "Control": CONTROL,
        "ControlReply": CONTROL,
    }
)
OTHER: Final = CONTROL  # a message that is not in the table

# Text in a message: of one line, without characters that a terminal interprets
LONGEST_ID: Final = 64
LONGEST_TEXT: Final = 512
ID_PATTERN: Final = rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{LONGEST_ID - 1}}}"
HASH_PATTERN: Final = r"[A-Za-z0-9]{0,64}"

LISTED_REFUSALS: Final = 256  # newest refusals, dropped rollouts, and those in flight, in one report


def budget_of(name: str) -> Budget:
    """Return the budget of a message type."""
    return BUDGETS.get(name, OTHER)


def one_line(text: str, longest: int = LONGEST_TEXT) -> str:
    """Return text of a peer as one short line that no terminal interprets: other characters stand as escapes."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[: longest + 1])
    return line if len(line) <= longest else f"{line[: longest - 3]}..."


# Header bytes 0xc0 to 0xdf of msgpack: bytes of the length, bytes after it, and items for each unit of the length. With
# no item, the length counts bytes.
_HEADERS: Final = (
    *((0, 0, 0),) * 4,  # nil, unused, false, true
    *((1, 0, 0), (2, 0, 0), (4, 0, 0)),  # bin
    *((1, 1, 0), (2, 1, 0), (4, 1, 0)),  # ext
    *((0, 4, 0), (0, 8, 0)),  # float
    *((0, 1, 0), (0, 2, 0), (0, 4, 0), (0, 8, 0)),  # uint
    *((0, 1, 0), (0, 2, 0), (0, 4, 0), (0, 8, 0)),  # int
    *((0, 2, 0), (0, 3, 0), (0, 5, 0), (0, 9, 0), (0, 17, 0)),  # fixext
    *((1, 0, 0), (2, 0, 0), (4, 0, 0)),  # str
    *((2, 0, 1), (4, 0, 1)),  # array
    *((2, 0, 2), (4, 0, 2)),  # map
)


def items_in(body: memoryview, most: int) -> int:
    """Return how many items a msgpack body has, or ``most + 1`` if there are more; nothing is built.

    A body that is cut or joined is the unpacker's to refuse.
    """
    at, left, items, end = 0, 1, 0, len(body)
    while left and at < end:
        header = body[at]
        at, left, items = at + 1, left - 1, items + 1
        if items + left > most:
            return most + 1
        if header < 0x80 or header >= 0xE0:
            continue
        if header < 0x90:
            left += 2 * (header & 15)
        elif header < 0xA0:
            left += header & 15
        elif header < 0xC0:
            at += header & 31
        else:
            width, more, each = _HEADERS[header - 0xC0]
            length = int.from_bytes(body[at : at + width], "big")
            at += width + more
            if each:
                left += each * length
            else:
                at += length
    return items + left if items + left <= most else most + 1
