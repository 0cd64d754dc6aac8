"""Settings of a service from flags, environment, a TOML file and defaults, in this order of precedence.

* Flags: ``--max-lag 1``, ``--ppo.clip 0.2``; a list is ``a,b``.
* Environment: ``TOPSPIN_LEARNER__PPO__CLIP=0.2`` for one service; ``TOPSPIN_RUN=night`` for a setting that
  all services share, which is one that the model inherits. A program that starts services hears only its own:
  ``TOPSPIN_LOCAL__LEARNER__PPO__CLIP=0.2``.
* File (``--config``, or ``TOPSPIN_CONFIG``): a table per service (``[learner]``), shared settings above them.

Whatever nobody reads is an error that suggests the nearest name: a mistyped setting never runs a whole night
as its default. pydantic-settings merges the layers; their keys are read here, since its own sources pass over
an unknown variable in silence, and can't tell where a bad value came from.
"""

import difflib
import os
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import tomli_w
from pydantic import BaseModel, ValidationError, create_model
from pydantic_core import PydanticUndefined
from pydantic_settings import BaseSettings, InitSettingsSource, PydanticBaseSettingsSource

from common.config_help import Setting, format_help, settings_of

ENVIRONMENT_PREFIX: Final = "TOPSPIN_"
SECTIONS: Final = (
    "generator",
    "actor",
    "learner",
    "evaluator",
    "local",
    "play",
    "pictures",
    "real2sim",
    "report",
    "ship",
)

_Model = TypeVar("_Model", bound=BaseModel)


class ConfigError(ValueError):
    """A setting that can't be used: one line with the key, what was got, and what is allowed."""


class HelpRequest(Exception):  # noqa: N818 - not an error
    """Somebody asked for the help text, which this carries."""


@dataclass(slots=True)
class _Layer:
    """Values of one source, nested as the model is, and where each comes from by dotted path."""

    values: dict[str, Any] = field(default_factory=dict)
    origins: dict[str, str] = field(default_factory=dict)

    def put(self, path: str, value: Any, origin: str) -> None:
        """Set the value at a dotted path."""
        *parents, name = path.split(".")
        table = self.values
        for parent in parents:
            table = table.setdefault(parent, {})
        table[name] = value
        self.origins[path] = origin


def load(
    model: type[_Model],
    argv: Sequence[str],
    *,
    prog: str,
    section: str,
    environ: Mapping[str, str] | None = None,
    elsewhere: Callable[[Iterable[str]], Mapping[str, str]] = lambda _: {},
    set_by: str = "the run",
    recorded: Path | None = None,
) -> _Model:
    """Return the settings of one service.

    Args:
        model: What there is to set.
        argv: Flags, without the program's name.
        prog: How the program is called, for the help text.
        section: The service's table in the file and its part of the environment's names.
        environ: Environment; the process's by default.
        elsewhere: Of all dotted paths, those that are no flags, and which flag to give instead ("": none).
        set_by: Who sets those for which there is none.
        recorded: What a run that goes on was last played with: its file, unless ``--config`` names one. A file that
            the environment names for whatever is started doesn't take its place.

    Raises:
        ConfigError: An unknown or unusable setting.
        HelpRequest: ``--help`` is among the flags.
    """
    settings = settings_of(model)
    layers = _read(model, settings, argv, prog, section, environ, elsewhere(settings), set_by, recorded)
    return _merged(model, (*layers, _nested_defaults(settings)), settings, section)


def first_look(
    model: type[BaseModel],
    names: Sequence[str],
    argv: Sequence[str],
    *,
    prog: str,
    section: str,
    environ: Mapping[str, str] | None = None,
    elsewhere: Callable[[Iterable[str]], Mapping[str, str]] = lambda _: {},
) -> tuple[Any, frozenset[str]]:
    """Return some settings, by which it is decided where the others come from, before those can be judged.

    Args:
        model: What there is to set.
        names: Of the fields that are looked at, none of them a model.
        argv: Flags, without the program's name.
        prog: How the program is called, for the help text.
        section: The service's table in the file and its part of the environment's names.
        environ: Environment; the process's by default.
        elsewhere: As for `load`.

    Returns:
        An object with these fields, and the dotted paths of all settings that flags and environment give.

    Raises:
        ConfigError: An unknown flag or variable, or one of these settings is unusable.
        HelpRequest: ``--help`` is among the flags.
    """
    settings = settings_of(model)
    layers = _read(model, settings, argv, prog, section, environ, elsewhere(settings), "the run", None)
    some = [
        _Layer({name: layer.values[name] for name in names if name in layer.values}, layer.origins)
        for layer in layers
    ]
    fields: dict[str, Any] = {
        name: (model.model_fields[name].annotation, model.model_fields[name]) for name in names
    }
    looked_at = _merged(create_model("Some", **fields), some, settings, section)
    return looked_at, frozenset(layers[0].origins | layers[1].origins)


def to_table(model: BaseModel) -> dict[str, Any]:
    """Return the settings as the table of a file that `load` reads back."""
    return model.model_dump(mode="json", by_alias=True, exclude_none=True)


def record(file: Path, tables: Mapping[str, Any]) -> None:
    """Put ``tables`` in the place of a settings file's own of these names, in one step; its other tables stay.

    Raises:
        ConfigError: What is in the file is not TOML.
    """
    before = read_toml(file) if file.exists() else {}
    part = file.with_name(f"{file.name}.part")
    part.write_text(tomli_w.dumps({**before, **tables}), encoding="utf-8")
    os.replace(part, file)  # services that are just starting read it


def read_toml(file: Path) -> dict[str, Any]:
    """Return what is in a settings file. Raises ConfigError if it can't be read or is not TOML."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"can't read {file}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file} is not TOML: {error}") from error


def _merged(
    model: type[_Model], layers: Sequence[_Layer], settings: Mapping[str, Setting], section: str
) -> _Model:
    class Layered(BaseSettings):
        @classmethod
        def settings_customise_sources(
            cls, settings_cls: type[BaseSettings], *_: Any, **__: Any
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return tuple(InitSettingsSource(settings_cls, {"settings": layer.values}) for layer in layers)

    try:
        loaded = create_model("Loaded", __base__=Layered, settings=(model, ...))()
    except ValidationError as error:
        raise ConfigError(_first_line(error, settings, layers, section)) from error
    merged: _Model = loaded.settings  # type: ignore[attr-defined]  # the field made a line above
    return merged


def _nested_defaults(settings: Mapping[str, Setting]) -> _Layer:
    """Return what a model gives the models within it, which setting one of their fields must not undo."""
    layer = _Layer()
    for path, setting in settings.items():
        if "." in path and setting.default is not PydanticUndefined:
            layer.put(path, setting.default, "default")
    return layer


# ---- the sources


def _read(
    model: type[BaseModel],
    settings: Mapping[str, Setting],
    argv: Sequence[str],
    prog: str,
    section: str,
    environ: Mapping[str, str] | None,
    elsewhere: Mapping[str, str],
    set_by: str,
    recorded: Path | None,
) -> tuple[_Layer, _Layer, _Layer]:
    """Return what flags, environment and file say."""
    environ = os.environ if environ is None else environ
    flags, file = _read_flags(argv, model, settings, prog, section, elsewhere, set_by)
    environment = _read_environment(environ, settings, section, elsewhere, set_by)
    file = file or str(recorded or environ.get(f"{ENVIRONMENT_PREFIX}CONFIG", ""))
    return flags, environment, _read_file(file, settings, section) if file else _Layer()


def _read_flags(
    argv: Sequence[str],
    model: type[BaseModel],
    settings: Mapping[str, Setting],
    prog: str,
    section: str,
    elsewhere: Mapping[str, str],
    set_by: str,
) -> tuple[_Layer, str]:
    """Return what the flags set, and the file they name."""
    settings = {path: setting for path, setting in settings.items() if path not in elsewhere}
    layer, file = _Layer(), ""
    words = list(argv)
    while words:
        word = words.pop(0)
        if word in ("-h", "--help"):
            raise HelpRequest(format_help(prog, model, settings, section))
        if not word.startswith("--"):
            raise ConfigError(f"unexpected argument {word!r}; settings are given as --name value")
        name, equals, value = word[2:].partition("=")
        path = name.replace("-", "_")
        setting = settings.get(path)
        if path in elsewhere:
            instead = f"give --{flag_of(elsewhere[path])}" if elsewhere[path] else f"{set_by} sets it"
            raise ConfigError(f"--{name} can't be set here: {instead}")
        if setting is None and path != "config":
            flags = [f"--{flag_of(known)}" for known in settings]
            raise ConfigError(f"unknown flag --{name}{_suggestion(f'--{name}', flags)}")
        if not equals:
            is_switch = setting is not None and setting.is_switch and not (words and words[0] in _BOOLEANS)
            if not is_switch and (not words or words[0].startswith("--")):
                raise ConfigError(f"--{name} needs a value")
            value = "true" if is_switch else words.pop(0)
        if setting is None:
            file = value
        else:
            layer.put(path, setting.parse(value), f"--{name}")
    return layer, file


_BOOLEANS: Final = ("true", "false", "yes", "no", "on", "off", "1", "0")


def _read_environment(
    environ: Mapping[str, str],
    settings: Mapping[str, Setting],
    section: str,
    elsewhere: Mapping[str, str],
    set_by: str,
) -> _Layer:
    layer = _Layer()
    names = {_variable(path, section): path for path in settings}
    shared = {f"{ENVIRONMENT_PREFIX}{path.upper()}": path for path in settings if settings[path].is_shared}
    # A program that has others' settings among its own starts them, and tells them all: their variables set nothing.
    started = {path.split(".")[0] for path in settings if "." in path} & set(SECTIONS)
    theirs = tuple(f"{ENVIRONMENT_PREFIX}{other.upper()}__" for other in started)
    others = tuple(
        f"{ENVIRONMENT_PREFIX}{other.upper()}__" for other in SECTIONS if other not in (section, *started)
    )
    # a service's own variable beats the shared one, so it is put last
    for variable in sorted(environ, key=lambda variable: variable in names):
        if not variable.startswith(ENVIRONMENT_PREFIX) or variable.startswith(others):
            continue
        ours = variable
        if variable.startswith(theirs):
            ours = variable.replace(ENVIRONMENT_PREFIX, f"{ENVIRONMENT_PREFIX}{section.upper()}__", 1)
        path = names.get(ours) or shared.get(ours)
        if path is not None and (path in elsewhere or ours != variable):
            instead = elsewhere.get(path, path)
            what = f"set {_variable(instead, section)}" if instead else f"{set_by} sets it"
            raise ConfigError(f"{variable} would set nothing here: {what}")
        if path is not None:
            layer.put(path, settings[path].parse(environ[variable]), variable)
        elif variable != f"{ENVIRONMENT_PREFIX}CONFIG":
            raise ConfigError(f"unknown variable {variable}{_suggestion(variable, [*names, *shared])}")
    return layer


def _read_file(file: str, settings: Mapping[str, Setting], section: str) -> _Layer:
    content = read_toml(Path(file))
    layer = _Layer()
    shared = [path for path, setting in settings.items() if setting.is_shared]
    for key, value in content.items():
        if key in shared:
            layer.put(key, value, file)
        elif key not in SECTIONS:
            raise ConfigError(f"unknown key {key!r} in {file}{_suggestion(key, [*SECTIONS, *shared])}")
    table = content.get(section, {})
    if not isinstance(table, dict):
        raise ConfigError(f"{section} in {file} is {table!r}; allowed: a table [{section}]")
    for path, value in _leaves(table, settings):
        if path not in settings:
            parent, dot, name = path.rpartition(".")
            group = parent + dot
            siblings = {p.removeprefix(group).split(".")[0] for p in settings if p.startswith(group)}
            raise ConfigError(
                f"unknown key {section}.{parent}{dot}{name!r} in {file}{_suggestion(name, sorted(siblings))}"
            )
        layer.put(path, value, file)
    return layer


def _leaves(
    table: Mapping[str, Any], settings: Mapping[str, Setting], parent: str = ""
) -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        path = f"{parent}{name}"
        is_group = any(other.startswith(f"{path}.") for other in settings)
        if is_group and isinstance(value, dict):
            yield from _leaves(value, settings, f"{path}.")
        else:
            yield path, value


# ---- messages


def flag_of(path: str) -> str:
    """Return a setting's flag without its dashes."""
    return path.replace("_", "-")


def _variable(path: str, section: str) -> str:
    return f"{ENVIRONMENT_PREFIX}{section}__{path.replace('.', '__')}".upper()


def _suggestion(name: str, known: Sequence[str]) -> str:
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {nearest[0]!r}?" if nearest else f"; allowed: {', '.join(sorted(known))}"


def _first_line(
    error: ValidationError, settings: Mapping[str, Setting], layers: Sequence[_Layer], section: str
) -> str:
    """Return one line about the first thing that is wrong."""
    errors = error.errors(include_url=False)
    first = errors[0]
    location = [str(part) for part in first["loc"][1:]]  # without "settings", the name of the merged field
    path = next((p for n in range(len(location), 0, -1) if (p := ".".join(location[:n])) in settings), "")
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    if not path:
        return f"{'.'.join([section, *location])}: {first['msg'].removeprefix('Value error, ')}{more}"
    origin = next((layer.origins[path] for layer in layers if path in layer.origins), "default")
    return f"{section}.{path} = {first['input']!r} ({origin}); allowed: {settings[path].allowed}{more}"
