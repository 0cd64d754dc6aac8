"""What there is to set, as a model declares it: type, unit, range and default of each field, for people."""

import inspect
import json
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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


@dataclass(frozen=True, slots=True)
class Setting:
    """One field of a model or of a model within it."""

    path: str  # dotted
    kind: Any
    unit: str
    description: str
    default: Any
    allowed: str  # type and range in words
    is_shared: bool  # inherited: all services have it

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
            return text
        if text.startswith("["):
            try:
                return json.loads(text)
            except ValueError:
                return text
        return [item.strip() for item in text.split(",") if item.strip()]


def settings_of(model: type[BaseModel], parent: str = "") -> dict[str, Setting]:
    """Return all settings by dotted path, those of nested models in the place of the model."""
    inherited = {name for base in model.__mro__[1:] for name in getattr(base, "model_fields", {})}
    found: dict[str, Setting] = {}
    for name, info in model.model_fields.items():
        path = (
            f"{parent}{info.alias or name}"  # an alias is for names that pydantic keeps to itself, like json
        )
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
            is_shared=not parent and name in inherited,
        )
    return found


def format_help(prog: str, model: type[BaseModel], settings: Mapping[str, Setting], section: str) -> str:
    """Return the text of ``--help``: a line per setting with unit, range and default."""
    rows = [(f"--{path.replace('_', '-')}", setting) for path, setting in settings.items()]
    width = max((len(flag) for flag, _ in rows), default=0)
    purpose = inspect.cleandoc(model.__doc__ or "").splitlines()
    lines = [f"usage: {prog} [--config FILE] [--NAME VALUE ...]", "", *purpose, ""]
    lines.append(f"  {'--config':{width}}  TOML file with a table [{section}]")
    for flag, setting in rows:
        unit = f" [{setting.unit}]" if setting.unit else ""
        details = f"{setting.allowed}; default {_shown(setting.default)}"
        lines.append(f"  {flag:{width}}  {setting.description}{unit} ({details})")
    example = next((path for path in settings if "." in path), next(iter(settings), "name"))
    variable = f"TOPSPIN_{section.upper()}__{example.upper().replace('.', '__')}"
    lines += [
        "",
        "Flags beat the environment, the environment beats the file. In the environment "
        f"--{example.replace('_', '-')} is called {variable}.",
    ]
    shared = ", ".join(f"TOPSPIN_{path.upper()}" for path, setting in settings.items() if setting.is_shared)
    if shared:
        lines += ["Some go without the first name too:", shared]
    return "\n".join(lines) + "\n"


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
    """Return the type in words, and what it may be by the rules it is annotated with."""
    low = high = ""
    extra = []
    for rule in rules:
        if isinstance(rule, annotated_types.Gt):
            low = f"above {rule.gt:g}"
        elif isinstance(rule, annotated_types.Ge):
            low = f"from {rule.ge:g}"
        elif isinstance(rule, annotated_types.Lt):
            high = f"below {rule.lt:g}"
        elif isinstance(rule, annotated_types.Le):
            high = f"to {rule.le:g}"
        elif (pattern := getattr(rule, "pattern", None)) is not None:
            extra.append(f"matching {pattern}")
    limits = " ".join(part for part in (low, high) if part)
    return ", ".join(part for part in (_words(kind), limits, *extra) if part)


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
    return str(value) if str(value) else "empty"
