"""What a message type declares about its fields, in one small object per field."""

import dataclasses
import math
import typing
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol


class Message(Protocol):
    """A frozen dataclass with a version; it may define `fault` for what its fields can't say."""

    VERSION: ClassVar[int]
    __dataclass_fields__: ClassVar[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Wire:
    """What one field of a message holds.

    Args:
        unit: Unit of the number or numbers; "1" without one, "" where the question makes no sense.
        dtype: numpy dtype of an array, with its byte order.
        dims: Shape of an array: names that mean the same length throughout the message, or numbers.
        low: Least value allowed.
        high: Greatest value allowed.
        nan: Whether NaN means something here. Infinity never does.
    """

    unit: str = ""
    dtype: str = ""
    dims: str = ""
    low: float = -math.inf
    high: float = math.inf
    nan: bool = False


@dataclass(frozen=True, slots=True)
class Slot:
    """One field of a message type, as its declaration says."""

    name: str
    kind: Any  # the annotation without Annotated
    wire: Wire
    has_default: bool


_slots_by_type: dict[type, tuple[Slot, ...]] = {}


def slots_of(kind: type) -> tuple[Slot, ...]:
    """Return the fields of a message type, in their order."""
    if kind not in _slots_by_type:
        _slots_by_type[kind] = _declared_slots(kind)
    return _slots_by_type[kind]


def _declared_slots(kind: type) -> tuple[Slot, ...]:
    hints = typing.get_type_hints(kind, include_extras=True)
    slots = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        wire = next((extra for extra in getattr(hint, "__metadata__", ()) if isinstance(extra, Wire)), None)
        has_default = (field.default, field.default_factory) != (dataclasses.MISSING, dataclasses.MISSING)
        kind_of_field = hint.__origin__ if hasattr(hint, "__metadata__") else hint
        slots.append(Slot(field.name, kind_of_field, wire or Wire(), has_default))
    return tuple(slots)


class Dims:
    """The lengths that a message's dimension names have taken, and who set them."""

    def __init__(self) -> None:
        self._lengths: dict[str, tuple[int, str]] = {}

    def fault(self, shape: tuple[int, ...], dims: str, where: str) -> str:
        """Return what is wrong with a shape, or ""."""
        names = dims.split()
        if len(shape) != len(names):
            return f"shape {shape}; allowed: [{', '.join(names)}]"
        for length, name in zip(shape, names, strict=True):
            known = (int(name), "") if name.isdigit() else self._lengths.setdefault(name, (length, where))
            wanted, setter = known
            if length != wanted:
                source = f" with {name} = {wanted} as in {setter}" if setter else ""
                return f"shape {shape}; allowed: [{', '.join(names)}]{source}"
        return ""
