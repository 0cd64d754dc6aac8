"""The settings of a model, as text: type, unit, range and default of each field, and the text of ``--help``."""

import inspect
import json
import shutil
import textwrap
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

_TYPE_WORDS: Final = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    Path: "a path",
}


WIDTH: Final = 80  # columns, or fewer where the terminal has fewer
_TEXT_COLUMN: Final = 26
_MOST_DIGITS: Final = 19  # of a setting: none is above 2^63


@dataclass(frozen=True, slots=True)
class Setting:
    """One field of a model or of a model within it."""

    path: str  # dotted
    kind: Any
    unit: str
    description: str
    default: Any
    allowed: str  # type and range in words

    @property
    def is_switch(self) -> bool:
        """Whether the flag may stand alone."""
        return self.kind is bool

    def parse(self, text: str) -> Any:
        """Return the value that a flag or variable means; the model checks it."""
        if type(None) in typing.get_args(self.kind) and text.lower() == "none":
            return None
        if typing.get_origin(self.kind) is Literal:
            return next((choice for choice in typing.get_args(self.kind) if str(choice) == text), text)
        if not _is_list(self.kind):
            return _whole(text) if self.kind is int else text
        if text.startswith("["):
            try:
                return json.loads(text)
            except ValueError:
                return text
        return [item.strip() for item in text.split(",") if item.strip()]


def _whole(text: str) -> str:
    """Return a whole number that is written with an exponent, such as 60e6, without it; other text as it is."""
    try:
        number = Decimal(text) if "e" in text.lower() else Decimal("nan")
    except InvalidOperation:
        return text
    is_short = (
        number.is_finite() and number.adjusted() < _MOST_DIGITS
    )  # 1e999999999 would be a gigabyte of zeros
    return f"{number:f}" if is_short and number == number.to_integral_value() else text


def settings_of(model: type[BaseModel], parent: str = "") -> dict[str, Setting]:
    """Return all settings by dotted path, with those of nested models in the model's place."""
    found: dict[str, Setting] = {}
    for name, info in model.model_fields.items():
        path = f"{parent}{info.alias or name}"  # an alias is for names that pydantic reserves, like json
        kind = info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            default = info.get_default(call_default_factory=True)
            for inner_path, setting in settings_of(kind, f"{path}.").items():
                found[inner_path] = _with_default_of(setting, default, inner_path.removeprefix(f"{path}."))
            continue
        unit = info.json_schema_extra.get("unit", "") if isinstance(info.json_schema_extra, dict) else ""
        found[path] = Setting(
            path=path,
            kind=kind,
            unit=str(unit),
            description=info.description or "",
            default=info.get_default(call_default_factory=True),
            allowed=_allowed(info),
        )
    return found


def format_help(
    prog: str, model: type[BaseModel], settings: Mapping[str, Setting], variable: str, *, every: bool
) -> str:
    """Return the text of ``--help``, or of ``--help-all`` if ``every``.

    Args:
        prog: How the program is called.
        model: Its docstring says what the program does; its ``often`` names the settings that people change, in
            groups with a title. All settings are grouped by their tables.
        settings: All settings.
        variable: Example of a setting's name in the environment.
        every: Whether all settings are listed.
    """
    often: Mapping[str, Sequence[str]] = getattr(model, "often", {})
    groups = _by_table(model, settings) if every or not often else often
    width = min(shutil.get_terminal_size((WIDTH, 24)).columns, WIDTH)
    purpose = inspect.cleandoc(model.__doc__ or "").splitlines()
    lines = [f"usage: {prog} [--NAME VALUE ...] [--config FILE]", ""]
    for paragraph in _paragraphs(purpose):
        lines += [*textwrap.wrap(paragraph, width), ""]
    for title, paths in groups.items():
        lines += textwrap.wrap(f"{title}:", width)
        for path in paths:
            lines += _entry(f"--{path.replace('_', '-')}", _details(settings[path]), width)
        lines.append("")
    lines.append("Also:")
    lines += _entry("--config FILE", "TOML file of settings", width)
    lines += _entry(
        "--print-config", "print the settings that differ from the defaults, as such a file", width
    )
    if sum(map(len, groups.values())) < len(settings):
        lines += _entry("--help-all", f"all {len(settings)} settings", width)
    recipe = "which beats the recipe, " if "recipe" in settings else ""
    lines += [
        "",
        *textwrap.wrap(
            f"Flags beat the environment ({variable}), which beats the file, {recipe}which beats the defaults.",
            width,
        ),
    ]
    return "\n".join(lines) + "\n"


def _by_table(model: type[BaseModel], settings: Mapping[str, Setting]) -> dict[str, list[str]]:
    """Return the settings' paths in groups: those of the program, then those of each table, titled with its purpose."""
    groups: dict[str, list[str]] = {}
    for path in sorted(settings, key=lambda path: "." in path):
        title, owner = "Settings", model
        *tables, _ = path.split(".")
        for table in tables:
            owner = owner.model_fields[table].annotation  # type: ignore[assignment]  # settings_of found a model there
        if tables:
            purpose = inspect.cleandoc(owner.__doc__ or "").partition("\n")[0].rstrip(".")
            title = f"[{'.'.join(tables)}] {purpose}".rstrip()
        groups.setdefault(title, []).append(path)
    return groups


def _paragraphs(lines: Sequence[str]) -> list[str]:
    return [" ".join(part.split()) for part in "\n".join(lines).split("\n\n") if part.strip()]


def _details(setting: Setting) -> str:
    unit = f" [{setting.unit}]" if setting.unit else ""
    allowed = "" if setting.kind is str else f"{setting.allowed}; "
    return f"{setting.description}{unit} ({allowed}default {_shown(setting.default)})"


def _entry(flag: str, text: str, width: int) -> list[str]:
    """Return a flag and its text: on one line if the flag is short, else on two."""
    indent = " " * _TEXT_COLUMN
    lines = textwrap.wrap(text, max(width - _TEXT_COLUMN, 30), break_long_words=False)
    head = f"  {flag}"
    if len(head) < _TEXT_COLUMN - 1:
        return [f"{head:{_TEXT_COLUMN}}{lines[0]}", *(indent + line for line in lines[1:])]
    return [head, *(indent + line for line in lines)]


def _with_default_of(setting: Setting, owner: Any, path: str) -> Setting:
    """Return the setting with the default that the outer model gives it."""
    value = owner
    for name in path.split("."):
        if not isinstance(value, BaseModel):
            return setting
        fields = {info.alias or field: field for field, info in type(value).model_fields.items()}
        value = getattr(value, fields[name])
    return replace(setting, default=value)


def _allowed(info: FieldInfo) -> str:
    return _limited(info.annotation, info.metadata)


def _limited(kind: Any, rules: Sequence[Any]) -> str:
    """Return the type and its allowed range in words."""
    low = high = ""
    extra = []
    for rule in rules:
        if isinstance(rule, annotated_types.Gt):
            low = f"above {_number(rule.gt)}"
        elif isinstance(rule, annotated_types.Ge):
            low = f"from {_number(rule.ge)}"
        elif isinstance(rule, annotated_types.Lt):
            high = f"below {_number(rule.lt)}"
        elif isinstance(rule, annotated_types.Le):
            high = f"to {_number(rule.le)}"
        elif (pattern := getattr(rule, "pattern", None)) is not None:
            extra.append(f"matching {pattern}")
    limits = " ".join(part for part in (low, high) if part)
    return ", ".join(part for part in (_words(kind), limits, *extra) if part)


def _number(value: Any) -> str:
    """Return a limit for people: large powers of two as such, no exponents for whole numbers."""
    if isinstance(value, int) and value >= 2**20 and value & (value - 1) == 0:
        return f"2^{value.bit_length() - 1}"
    return str(value) if isinstance(value, int) else f"{value:g}"


def _words(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return _limited(arguments[0], arguments[1:])
    if origin is Literal:
        return ", ".join(str(choice) for choice in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join("none" if argument is type(None) else _words(argument) for argument in arguments)
    if _is_list(kind):
        return f"list of {_words(arguments[0]) if arguments else 'values'}"
    return _TYPE_WORDS.get(kind, getattr(kind, "__name__", str(kind)))


def _is_list(kind: Any) -> bool:
    return typing.get_origin(kind) in (tuple, list)


def _shown(value: Any) -> str:
    if value is PydanticUndefined:
        return "none: it must be given"
    if isinstance(value, (tuple, list)):
        return ",".join(str(item) for item in value) or "empty"
    if isinstance(value, bool) or value is None:
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    return str(value) if str(value) else "empty"
