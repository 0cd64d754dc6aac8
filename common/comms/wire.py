"""Declarations of a message type's fields: one small object per field."""

import dataclasses
import math
import typing
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol


class Message(Protocol):
    """A frozen dataclass with a version. It may define `fault` to check what no single field can check."""

    VERSION: ClassVar[int]
    __dataclass_fields__: ClassVar[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Wire:
    """The content of one field of a message.

    Args:
        unit: Unit of the number or numbers: "1" for a number without unit, "" for a field that is not a number.
        dtype: numpy dtype of an array, with its byte order.
        dims: Shape of an array: numbers, or names. A name has the same length throughout the message.
        low: Least value allowed.
        high: Greatest value allowed.
        nan: Whether NaN is allowed. Infinity never is.
        text: Pattern of a text; "": any printable one of up to `budgets.LONGEST_TEXT` characters.
        sent: dtype of an array in the message, where it is narrower than ``dtype``; "": the same.
    """

    unit: str = ""
    dtype: str = ""
    dims: str = ""
    low: float = -math.inf
    high: float = math.inf
    nan: bool = False
    text: str = ""
    sent: str = ""


@dataclass(frozen=True, slots=True)
class Slot:
    """One field of a message type, as declared."""

    name: str
    kind: Any  # the annotation without Annotated
    wire: Wire
    has_default: bool


_slots_by_type: dict[type, tuple[Slot, ...]] = {}


def slots_of(kind: type) -> tuple[Slot, ...]:
    """Return the fields of a message type, in order of declaration."""
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
    """The length of each dimension name of one message, and the field that set it."""

    def __init__(self) -> None:
        self._lengths: dict[str, tuple[int, str]] = {}

    def fault(self, shape: tuple[int, ...], dims: str, where: str) -> str:
        """Return the fault of a shape, or "" for a valid one."""
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
