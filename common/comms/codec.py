"""Encoding of messages as bytes, and decoding. Only this file uses msgpack.

A message on the wire is ``b"TSPN" | crc32 of the body | length of the body | body``, all little endian. The
body is the msgpack array ``[type, version, {field: value}]``. In it an array is ``[dtype, shape, bytes]``.
The checksum separates corrupt bytes from a wrong format. Decoding checks everything that the message's fields
declare, so the receiver needs no checks of its own. Decoded arrays are read-only.

    @dataclass(frozen=True, slots=True, eq=False)
    class Rollout:
        VERSION: ClassVar[int] = 1
        rewards: Annotated[F32, Wire("1", "<f4", "T B")]
"""

import dataclasses
import math
import re
import struct
import typing
import zlib
from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import Any, Final, TypeVar

import msgpack
import numpy as np

from common.comms.budgets import LARGEST, LONGEST_TEXT, budget_of, items_in, one_line
from common.comms.wire import Dims, Message, Wire, slots_of

MAGIC: Final = b"TSPN"

_HEADER: Final = struct.Struct("<4sII")
_MAX_ITEMS: Final = 65_536  # of one msgpack array or map; arrays of numbers travel as bytes


class DecodeError(ValueError):
    """Bytes that are not the expected message. The text names the field, what was got and what is allowed."""


class EncodeError(ValueError):
    """A message whose fields differ from their declaration."""


_M = TypeVar("_M", bound=Message)


def encode(message: Message) -> bytes:
    """Return the bytes of a message. Raises EncodeError if a field differs from its declaration."""
    kind = type(message)
    fields = _pack_fields(message, kind.__name__, Dims())
    try:
        body: bytes = msgpack.packb([kind.__name__, kind.VERSION, fields], use_bin_type=True)
    except (OverflowError, ValueError, TypeError) as error:
        raise EncodeError(f"{kind.__name__}: {error}") from error
    return _HEADER.pack(MAGIC, zlib.crc32(body), len(body)) + body


def decode(payload: bytes, expected: type[_M], *, limit_bytes: int = LARGEST) -> _M:
    """Return the checked message in ``payload``. For any bytes it raises DecodeError or nothing."""
    name, budget = expected.__name__, budget_of(expected.__name__)
    if len(payload) > (allowed := min(limit_bytes, budget.bytes)):
        raise DecodeError(f"{name}: {len(payload)} bytes; allowed: up to {allowed}")
    content = _unpack(_body(payload, name), name, budget.items)
    if not (isinstance(content, list) and len(content) == 3 and isinstance(content[2], dict)):
        raise DecodeError(f"{name}: the body is not [type, version, fields]")
    got_type, got_version, fields = content
    if got_type != name:
        raise DecodeError(f"got a message of type {_short(got_type)}; allowed here: {name}")
    if type(got_version) is not int or got_version != expected.VERSION:
        raise DecodeError(
            f"{name}: version {_short(got_version)}; allowed: {expected.VERSION}: run the same release everywhere"
        )
    return typing.cast(_M, _read_fields(fields, expected, name, Dims()))


def salvage(payload: bytes, expected: type[_M], names: tuple[str, ...]) -> dict[str, Any]:
    """Return the readable ones of the named plain fields of a message that is invalid as a whole.

    With them the learner can answer the sender of a rollout with a NaN, and name the rollout. Empty if the bytes are
    corrupt.
    """
    try:
        name = expected.__name__
        content = _unpack(_body(payload, name), name, budget_of(name).items)
        raw = content[2]
        return {
            slot.name: _read(raw[slot.name], slot.kind, slot.wire, slot.name, Dims())
            for slot in slots_of(expected)
            if slot.name in names and slot.name in raw
        }
    except (DecodeError, TypeError, LookupError):
        return {}


def _body(payload: bytes, name: str) -> memoryview:
    if len(payload) < _HEADER.size:
        raise DecodeError(f"{name}: {len(payload)} bytes are too few for a header of {_HEADER.size}")
    magic, checksum, length = _HEADER.unpack_from(payload)
    if magic != MAGIC:
        raise DecodeError(f"{name}: starts with {magic!r}, not with {MAGIC!r}: not a Topspin message")
    body = memoryview(payload)[_HEADER.size :]
    if len(body) != length:
        raise DecodeError(f"{name}: a body of {len(body)} bytes, the header says {length}: cut or joined")
    if zlib.crc32(body) != checksum:
        raise DecodeError(f"{name}: corrupt: checksum {zlib.crc32(body):08x}, the header says {checksum:08x}")
    return body


def _unpack(body: memoryview, name: str, most_items: int) -> Any:
    if len(body) > most_items and items_in(body, most_items) > most_items:
        raise DecodeError(f"{name}: more than {most_items} items; allowed: up to {most_items}")
    try:
        return msgpack.unpackb(body, max_array_len=_MAX_ITEMS, max_map_len=_MAX_ITEMS, ext_hook=_no_extension)
    # msgpack documents ValueError and its own exceptions; deep nesting and unusual keys raise the others
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise DecodeError(
            f"{name}: the body is not msgpack: {type(error).__name__} {error}".strip()
        ) from error


def _no_extension(code: int, _data: bytes) -> Any:
    raise ValueError(f"extension type {code}")


# ---- encoding


def _pack_fields(message: Any, path: str, dims: Dims) -> dict[str, Any]:
    return {
        slot.name: _pack(getattr(message, slot.name), slot.kind, slot.wire, f"{path}.{slot.name}", dims)
        for slot in slots_of(type(message))
    }


def _pack(value: Any, kind: Any, wire: Wire, path: str, dims: Dims) -> Any:
    if wire.dtype:
        return _pack_array(value, wire, path, dims)
    origin = typing.get_origin(kind)
    if origin is tuple:
        item_kind = typing.get_args(kind)[0]
        return [_pack(item, item_kind, wire, f"{path}[{i}]", Dims()) for i, item in enumerate(value)]
    if origin is Mapping:
        return {str(key): float(number) for key, number in value.items()}
    if not isinstance(value, kind) and not (kind is float and isinstance(value, int)):
        raise EncodeError(f"{path}: {type(value).__name__}; allowed: {kind.__name__}")
    if dataclasses.is_dataclass(kind):
        return _pack_fields(value, path, dims)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, str) and (fault := _text_fault(value, wire)):
        raise EncodeError(f"{path}: {fault}")
    return float(value) if kind is float else value


def _pack_array(value: Any, wire: Wire, path: str, dims: Dims) -> list[Any]:
    if not isinstance(value, np.ndarray) or value.dtype != np.dtype(wire.dtype):
        got = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise EncodeError(f"{path}: {got}; allowed: array of {np.dtype(wire.dtype)}")
    if fault := dims.fault(value.shape, wire.dims, path):
        raise EncodeError(f"{path}: {fault}")
    if not wire.sent:
        return [wire.dtype, list(value.shape), value.tobytes()]
    with np.errstate(over="ignore"):  # it becomes infinite, which the receiver refuses like any other
        return [wire.sent, list(value.shape), value.astype(wire.sent).tobytes()]


# ---- decoding


def _read_fields(raw: dict[Any, Any], kind: type, path: str, dims: Dims) -> Any:
    slots = slots_of(kind)
    unknown = raw.keys() - {slot.name for slot in slots}
    missing = [slot.name for slot in slots if slot.name not in raw and not slot.has_default]
    if unknown or missing:
        unknown_names = sorted(_short(name) for name in unknown)
        raise DecodeError(f"{path}: missing fields {missing}, unknown fields {unknown_names}")
    values = {
        slot.name: _read(raw[slot.name], slot.kind, slot.wire, f"{path}.{slot.name}", dims)
        for slot in slots
        if slot.name in raw
    }
    message = kind(**values)
    if fault := message.fault() if hasattr(message, "fault") else "":
        raise DecodeError(f"{path}: {fault}")
    return message


def _read(raw: Any, kind: Any, wire: Wire, path: str, dims: Dims) -> Any:
    if wire.dtype:
        return _read_array(raw, wire, path, dims)
    origin = typing.get_origin(kind)
    if origin is tuple:
        item_kind = typing.get_args(kind)[0]
        items = _of_type(raw, list, path)
        return tuple(_read(item, item_kind, wire, f"{path}[{i}]", Dims()) for i, item in enumerate(items))
    if origin is Mapping:
        pairs = _of_type(raw, dict, path).items()
        return MappingProxyType(
            {
                _name(key, path): _read(number, float, wire, f"{path}[{_short(key)}]", dims)
                for key, number in pairs
            }
        )
    if dataclasses.is_dataclass(kind):
        return _read_fields(_of_type(raw, dict, path), typing.cast(type, kind), path, dims)
    if issubclass(kind, Enum):
        return _read_enum(raw, kind, path)
    value = _of_type(raw, kind, path)
    if kind in (int, float):
        _check_number(value, wire, path)
    elif kind is str and (fault := _text_fault(value, wire)):
        raise DecodeError(f"{path}: {fault}")
    return value


def _name(raw: Any, path: str) -> str:
    """Return the name of a number."""
    name: str = _of_type(raw, str, path)
    if fault := _text_fault(name, Wire()):
        raise DecodeError(f"{path}: name of {fault}")
    return name


def _text_fault(text: str, wire: Wire) -> str:
    """Return why a text is not allowed, or ""."""
    if len(text) > LONGEST_TEXT:
        return f"{len(text)} characters; allowed: up to {LONGEST_TEXT}"
    if wire.text:
        return "" if re.fullmatch(wire.text, text) else f"{_short(text)}; allowed: {wire.text}"
    return "" if text.isprintable() else f"{_short(text)}; allowed: one line of printable characters"


def _of_type(raw: Any, kind: type, path: str) -> Any:
    if type(raw) is not kind:
        raise DecodeError(f"{path}: {_short(raw)} of type {type(raw).__name__}; allowed: {kind.__name__}")
    return raw


def _read_enum(raw: Any, kind: type[Enum], path: str) -> Enum:
    allowed = [member.value for member in kind]
    if not isinstance(raw, str) or raw not in allowed:
        raise DecodeError(f"{path}: {_short(raw)}; allowed: {', '.join(allowed)}")
    return kind(raw)


def _check_number(value: float, wire: Wire, path: str) -> None:
    is_allowed_nan = wire.nan and math.isnan(value)
    if not is_allowed_nan and not (math.isfinite(value) and wire.low <= value <= wire.high):
        raise DecodeError(f"{path}: {value}; allowed: {_range(wire)}")


def _read_array(raw: Any, wire: Wire, path: str, dims: Dims) -> Any:
    if not (isinstance(raw, list) and len(raw) == 3):
        raise DecodeError(f"{path}: {_short(raw)}; allowed: an array as [dtype, shape, bytes]")
    dtype, shape, content = raw
    sent = wire.sent or wire.dtype
    if dtype != sent:
        raise DecodeError(f"{path}: dtype {_short(dtype)}; allowed: {sent!r}")
    if not isinstance(shape, list) or not all(type(length) is int and length >= 0 for length in shape):
        raise DecodeError(f"{path}: shape {_short(shape)}; allowed: [{', '.join(wire.dims.split())}]")
    if fault := dims.fault(tuple(shape), wire.dims, path):
        raise DecodeError(f"{path}: {fault}")
    size = math.prod(shape) * np.dtype(sent).itemsize
    if type(content) is not bytes or len(content) != size:
        got = f"{len(content)} bytes" if type(content) is bytes else _short(content)
        raise DecodeError(f"{path}: {got}; allowed: {size} bytes for shape {tuple(shape)}")
    if wire.dtype == "|b1":
        _check_values(np.frombuffer(content, np.uint8).reshape(shape), Wire(low=0, high=1), path)
    # frombuffer on bytes gives a read-only array and makes no copy
    array = np.frombuffer(content, dtype=np.dtype(sent)).reshape(shape)
    if wire.sent:
        array = array.astype(wire.dtype)
        array.flags.writeable = False
    if wire.dtype != "|b1":
        _check_values(array, wire, path)
    return array


def _check_values(array: Any, wire: Wire, path: str) -> None:
    is_float = array.dtype.kind == "f"
    if array.size == 0 or not (is_float or math.isfinite(wire.low) or math.isfinite(wire.high)):
        return
    bad = ~np.isfinite(array) if is_float else np.zeros(array.shape, bool)
    if wire.nan:
        bad &= ~np.isnan(array)
    if math.isfinite(wire.low):
        bad |= array < wire.low
    if math.isfinite(wire.high):
        bad |= array > wire.high
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise DecodeError(
            f"{path}{list(first)}: {array[first]}; allowed: {_range(wire)} ({int(bad.sum())} such values)"
        )


def _range(wire: Wire) -> str:
    return f"{wire.low:g} to {wire.high:g}, finite" + (", or NaN" if wire.nan else "")


def _short(value: Any) -> str:
    if isinstance(value, str | bytes | list | tuple) and len(value) > 60:
        value = value[:60]  # no long text of a value that a peer made large
    elif isinstance(value, dict) and len(value) > 60:
        return f"a map of {len(value)}"
    return one_line(repr(value), 60)
