"""Settings of a program from flags, environment, a TOML file, a recipe and defaults, in this order of precedence.

* File (``--config``, or ``TOPSPIN_CONFIG``): shared settings at the top (``run = "night"``), one table for each of
  task, experience and network (``[task]``, ``[experience]``, ``[network]``), and one table per program (``[learner]``).
* Recipe (setting ``recipe``, where a program has it): a named file of the same form that comes with the project.
* Flags: ``--max-lag 1``, ``--ppo.clip 0.2``, ``--task.launch strong``; a list is ``a,b``.
* Environment: ``TOPSPIN_LEARNER__PPO__CLIP=0.2``; a table that several programs read has its own name there:
  ``TOPSPIN_TASK__LAUNCH=strong``; a shared setting needs no table: ``TOPSPIN_RUN=night``.

A program that starts others (``deploy.local``) reads their tables too: ``--learner.ppo.clip 0.2`` there is
``--ppo.clip 0.2`` of the learner, and the file is the same for both.

An unknown setting is an error that suggests the nearest name, so that a mistyped name never trains a whole night with
the default. pydantic-settings merges the layers. Their keys are read here, since its own sources ignore an unknown
variable and cannot name the origin of a bad value.
"""

import difflib
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import tomli_w
from pydantic import BaseModel, ValidationError, create_model
from pydantic_core import PydanticUndefined
from pydantic_settings import BaseSettings, InitSettingsSource, PydanticBaseSettingsSource

from common.errors import ReportedError
from common.service.config_help import Setting, format_help, settings_of
from common.service.whole_file import write_whole

ENVIRONMENT_PREFIX: Final = "TOPSPIN_"
RUN_TABLES: Final = (
    *("task", "experience", "network"),
    *("generator", "actor", "learner", "evaluator"),
    "local",
)
"""Tables of a run's file, which all its programs read, each what it needs."""
TABLES: Final = (
    *RUN_TABLES,
    *(
        "play",
        "view",
        "evaluate",
        "pictures",
        "real2sim",
        "report",
        "release",
        "export",
        "certs",
        "router",
        "bench",
    ),
)
"""Tables of a settings file. A nested model of one of these names is read from that table, whatever the program."""
SHARED: Final = (
    *("run", "seed", "actors", "generators", "shards", "minutes", "frames"),
    *(
        "endpoint",
        "peers",
        "connect_timeout_s",
        "lease_s",
        "max_message_mib",
        "tls",
    ),
    *("metrics_host", "log_level", "status_interval_s"),
)
"""Settings that the programs of a run share: they stand at the top of a file, outside any table."""

_Model = TypeVar("_Model", bound=BaseModel)


class ConfigError(ReportedError, ValueError):
    """A setting that can't be used: one line with the key, the value, and what is allowed."""


class HelpRequest(Exception):  # noqa: N818 - not an error
    """The help text was requested; the exception carries it."""


@dataclass(slots=True)
class _Layer:
    """Values of one source, nested as the model is, and the origin of each by dotted path."""

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


def _is_rooted(path: str) -> bool:
    """Return whether a setting stands in a table of its own name, whatever program reads it."""
    root, dot, _ = path.partition(".")
    return bool(dot) and root in TABLES


@dataclass(frozen=True, slots=True)
class _Program:
    """A program's settings: its model, and the table for its own settings."""

    model: type[BaseModel]
    settings: Mapping[str, Setting]
    prog: str
    section: str

    def name(self, path: str) -> str:
        """Return a setting's full name: its table, and its path in it."""
        return path if _is_rooted(path) else f"{self.section}.{path}"

    def variable(self, path: str) -> str:
        """Return a setting's name in the environment."""
        return ENVIRONMENT_PREFIX + self.name(path).replace(".", "__").upper()


def load(
    model: type[_Model],
    argv: Sequence[str],
    *,
    prog: str,
    section: str,
    environ: Mapping[str, str] | None = None,
    recorded: Path | None = None,
    recipes: Path | None = None,
) -> _Model:
    """Return the settings of one program.

    Args:
        model: Its fields are the settings.
        argv: Flags, without the program's name.
        prog: How the program is called, for the help text.
        section: The program's table in the file, and its part of the environment's names.
        environ: Environment; the process's by default.
        recorded: File with the settings of a resumed run; ``--config`` takes its place, but the environment's
            ``TOPSPIN_CONFIG`` does not.
        recipes: Folder of the recipes that have a name; None: setting ``recipe`` is not followed.

    Raises:
        ConfigError: An unknown or unusable setting.
        HelpRequest: ``--help`` or ``--help-all`` is among the flags.
    """
    program = _Program(model, settings_of(model), prog, section)
    layers = _read(program, argv, environ, recorded)
    recipe = next((layer.values["recipe"] for layer in layers if "recipe" in layer.values), "")
    if recipes is not None and recipe:
        layers = (*layers, _read_file(str(recipe_file(recipe, recipes)), program))
    return _merged(model, (*layers, _nested_defaults(program.settings)), program)


def recipe_names(folder: Path) -> list[str]:
    """Return the names of the recipes in a folder."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def recipe_file(given: str, folder: Path) -> Path:
    """Return the file of a recipe, given by its name in ``folder`` or as a file. Raises ConfigError."""
    names = recipe_names(folder)
    file = folder / f"{given}.toml" if given in names else Path(given)
    if not file.is_file():
        raise ConfigError(f"no recipe {given!r}; allowed: {', '.join(names)}, or a TOML file")
    return file


def first_look(
    model: type[BaseModel],
    names: Sequence[str],
    argv: Sequence[str],
    *,
    prog: str,
    section: str,
    environ: Mapping[str, str] | None = None,
) -> Any:
    """Return an object with the fields ``names``, which decide where the other settings come from.

    Raises:
        ConfigError: An unknown flag or variable, or one of these settings is unusable.
        HelpRequest: ``--help`` or ``--help-all`` is among the flags.
    """
    program = _Program(model, settings_of(model), prog, section)
    some = [
        _Layer({name: layer.values[name] for name in names if name in layer.values}, layer.origins)
        for layer in _read(program, argv, environ, None)
    ]
    fields: dict[str, Any] = {
        name: (model.model_fields[name].annotation, model.model_fields[name]) for name in names
    }
    return _merged(create_model("Some", **fields), some, program)


def to_tables(model: BaseModel, section: str) -> dict[str, Any]:
    """Return the settings as a file that `load` reads back: shared ones, tables that several programs read, its own."""
    values = model.model_dump(mode="json", by_alias=True, exclude_none=True)
    shared = {name: values.pop(name) for name in SHARED if name in values}
    tables = {name: values.pop(name) for name in TABLES if isinstance(values.get(name), dict)}
    return shared | tables | {section: values}


def save_settings(file: Path, tables: Mapping[str, Any]) -> None:
    """Replace these settings and tables of a settings file in one step; the others stay.

    Raises:
        ConfigError: The file is not TOML.
    """
    before = read_toml(file) if file.exists() else {}
    merged = {**before, **tables}
    ordered = dict(sorted(merged.items(), key=lambda item: isinstance(item[1], dict)))  # TOML: tables last
    write_whole(file, tomli_w.dumps(ordered))  # services that are just starting read it


def read_toml(file: Path) -> dict[str, Any]:
    """Return the content of a settings file. Raises ConfigError if it can't be read or is not TOML."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"can't read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # not TOML, no text, or beyond Python's limits
        raise ConfigError(f"{file} is not TOML: {error}") from error


def _merged(model: type[_Model], layers: Sequence[_Layer], program: _Program) -> _Model:
    class Layered(BaseSettings):
        @classmethod
        def settings_customise_sources(
            cls, settings_cls: type[BaseSettings], *_: Any, **__: Any
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return tuple(InitSettingsSource(settings_cls, {"settings": layer.values}) for layer in layers)

    try:
        loaded = create_model("Loaded", __base__=Layered, settings=(model, ...))()
    except ValidationError as error:
        raise ConfigError(_first_line(error, layers, program)) from error
    merged: _Model = loaded.settings  # type: ignore[attr-defined]  # the field made a line above
    return merged


def _nested_defaults(settings: Mapping[str, Setting]) -> _Layer:
    """Return the defaults that a model gives its nested models: setting one field must not reset the others."""
    layer = _Layer()
    for path, setting in settings.items():
        if "." in path and setting.default is not PydanticUndefined:
            layer.put(path, setting.default, "default")
    return layer


# ---- the sources


def _read(
    program: _Program, argv: Sequence[str], environ: Mapping[str, str] | None, recorded: Path | None
) -> tuple[_Layer, ...]:
    """Return the values from flags, environment and file."""
    environ = os.environ if environ is None else environ
    flags, file = _read_flags(argv, program)
    environment = _read_environment(environ, program)
    if file:
        _check_use(file, program)
    file = file or str(recorded or environ.get(f"{ENVIRONMENT_PREFIX}CONFIG", ""))
    return flags, environment, _read_file(file, program) if file else _Layer()


def _read_flags(argv: Sequence[str], program: _Program) -> tuple[_Layer, str]:
    """Return the values of the flags, and the file that they name."""
    settings = program.settings
    layer, file = _Layer(), ""
    words = list(argv)
    while words:
        word = words.pop(0)
        if word in ("-h", "--help", "--help-all"):
            raise HelpRequest(_help(program, every=word == "--help-all"))
        if not word.startswith("--"):
            raise ConfigError(f"unexpected argument {word!r}; settings are given as --name value")
        name, equals, value = word[2:].partition("=")
        path = name.replace("-", "_")
        setting = settings.get(path)
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


def _help(program: _Program, every: bool) -> str:
    example = next((path for path in program.settings if "." in path), next(iter(program.settings), "name"))
    name = f"--{flag_of(example)} is {program.variable(example)}"
    return format_help(program.prog, program.model, program.settings, name, every=every)


def _read_environment(environ: Mapping[str, str], program: _Program) -> _Layer:
    layer = _Layer()
    own = {program.variable(path): path for path in program.settings}
    shared = {f"{ENVIRONMENT_PREFIX}{path.upper()}": path for path in program.settings if path in SHARED}
    read = {program.name(path).split(".")[0] for path in program.settings}
    others = tuple(f"{ENVIRONMENT_PREFIX}{table.upper()}__" for table in TABLES if table not in read)
    unused = {f"{ENVIRONMENT_PREFIX}{name.upper()}" for name in SHARED} - shared.keys()
    # a program's own variable beats the shared one, so it is put last
    for variable in sorted(environ, key=lambda variable: variable in own):
        is_ours = variable.startswith(ENVIRONMENT_PREFIX) and not variable.startswith(others)
        if not is_ours or variable in unused or variable == f"{ENVIRONMENT_PREFIX}CONFIG":
            continue
        path = own.get(variable) or shared.get(variable)
        if path is None:
            raise ConfigError(f"unknown variable {variable}{_suggestion(variable, [*own, *shared])}")
        layer.put(path, program.settings[path].parse(environ[variable]), variable)
    return layer


def _check_use(file: str, program: _Program) -> None:
    """Raise ConfigError if a file that was given to this program has a table of another, or nothing for this one."""
    content = read_toml(Path(file))
    own = {path.split(".")[0] for path in program.settings if "." in path} & set(TABLES) | {program.section}
    reads = f"{program.prog} reads {', '.join(f'[{table}]' for table in TABLES if table in own)}"
    allowed = own | (set(RUN_TABLES) if own & set(RUN_TABLES) else set())
    for table in content:
        if table in TABLES and table not in allowed:
            raise ConfigError(f"[{table}] in {file} is not used: {reads}")
    known = content.keys() & {*TABLES, *SHARED}  # _read_file names the others
    if known == content.keys() != set() and not known & (own | program.settings.keys()):
        raise ConfigError(f"nothing in {file} is used: {reads}; got {', '.join(sorted(content))}")


def _read_file(file: str, program: _Program) -> _Layer:
    settings, section = program.settings, program.section
    content = read_toml(Path(file))
    layer = _Layer()
    for key, value in content.items():
        if key in TABLES:
            if not isinstance(value, dict):
                raise ConfigError(f"{key} in {file} is {value!r}; allowed: a table [{key}]")
            continue
        if key not in SHARED:
            raise ConfigError(f"unknown key {key!r} in {file}{_suggestion(key, [*TABLES, *SHARED])}")
        if key in settings:
            layer.put(key, value, file)
    nested = {path.split(".")[0] for path in settings if "." in path} & set(TABLES)
    tables = [(f"{table}.", content.get(table, {})) for table in sorted(nested)]
    for parent, table in [*tables, ("", content.get(section, {}))]:
        for path, value in _leaves(table, settings, parent):
            if not parent and _is_rooted(path):
                root = path.split(".")[0]
                raise ConfigError(
                    f"unknown key {section}.{path} in {file}; allowed: a table [{root}] of its own"
                )
            if path not in settings:
                raise ConfigError(_unknown_key(path, program, file))
            layer.put(path, value, file)
    return layer


def _unknown_key(path: str, program: _Program, file: str) -> str:
    full = program.name(path)
    parent, _, name = full.rpartition(".")
    group = path.rpartition(".")[0]
    siblings = {
        known.removeprefix(f"{group}." if group else "").split(".")[0]
        for known in program.settings
        if not group or known.startswith(f"{group}.")
    }
    return f"unknown key {parent}.{name!r} in {file}{_suggestion(name, sorted(siblings))}"


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


def _suggestion(name: str, known: Sequence[str]) -> str:
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {nearest[0]!r}?" if nearest else f"; allowed: {', '.join(sorted(known))}"


def _first_line(error: ValidationError, layers: Sequence[_Layer], program: _Program) -> str:
    """Return one line about the first error."""
    errors = error.errors(include_url=False)
    first = errors[0]
    location = [str(part) for part in first["loc"][1:]]  # without "settings", the name of the merged field
    path = next(
        (p for n in range(len(location), 0, -1) if (p := ".".join(location[:n])) in program.settings), ""
    )
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    if not path:
        where = program.name(".".join(location)) if location else program.section
        return f"{where}: {first['msg'].removeprefix('Value error, ')}{more}"
    origin = next((layer.origins[path] for layer in layers if path in layer.origins), "default")
    allowed = program.settings[path].allowed
    return f"{program.name(path)} = {first['input']!r} ({origin}); allowed: {allowed}{more}"
