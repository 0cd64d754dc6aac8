"""The sources of a program's settings: flags, environment and files, and one line about what can't be used in them."""

import difflib
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ValidationError

from common.errors import ConfigError, HelpRequest
from common.service.config_help import Setting, format_help

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


PRINT: Final = "--print-config"
BOOLEANS: Final = ("true", "false", "yes", "no", "on", "off", "1", "0")


@dataclass(slots=True)
class Layer:
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


def is_rooted(path: str) -> bool:
    """Return whether a setting stands in a table of its own name, whatever program reads it."""
    root, dot, _ = path.partition(".")
    return bool(dot) and root in TABLES


@dataclass(frozen=True, slots=True)
class Program:
    """A program's settings: its model, and the table for its own settings."""

    model: type[BaseModel]
    settings: Mapping[str, Setting]
    prog: str
    section: str

    def name(self, path: str) -> str:
        """Return a setting's full name: its table, and its path in it."""
        return path if is_rooted(path) else f"{self.section}.{path}"

    def variable(self, path: str) -> str:
        """Return a setting's name in the environment."""
        return ENVIRONMENT_PREFIX + self.name(path).replace(".", "__").upper()


def read_sources(
    program: Program,
    argv: Sequence[str],
    environ: Mapping[str, str] | None,
    recorded: Path | None,
    beneath: Path | None = None,
) -> tuple[tuple[Layer, ...], bool]:
    """Return the values from flags, environment and files; and whether ``--print-config`` is among the flags."""
    environ = os.environ if environ is None else environ
    prints = PRINT in argv
    flags = _read_flags([word for word in argv if word != PRINT], program)
    environment = _read_environment(environ, program)
    if file := named_file(argv, {}):
        _check_use(str(file), program)
    elif recorded is None:
        file = named_file((), environ)
    files = [str(one) for one in (file, recorded, beneath) if one]
    return (flags, environment, *(read_file(one, program) for one in files)), prints


def named_file(argv: Sequence[str], environ: Mapping[str, str]) -> Path | None:
    """Return the settings file that flags or the environment name, or None."""
    found = environ.get(f"{ENVIRONMENT_PREFIX}CONFIG", "")
    for word, following in pairwise((*argv, "")):
        name, equals, value = word.partition("=")
        if name == "--config":
            found = value if equals else following
    return Path(found) if found else None


def _read_flags(argv: Sequence[str], program: Program) -> Layer:
    """Return the values of the flags, without the file that they name."""
    settings = program.settings
    layer = Layer()
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
            is_switch = setting is not None and setting.is_switch and not (words and words[0] in BOOLEANS)
            if not is_switch and (not words or words[0].startswith("--")):
                raise ConfigError(f"--{name} needs a value")
            value = "true" if is_switch else words.pop(0)
        if setting is not None:
            layer.put(path, setting.parse(value), f"--{name}")
    return layer


def _help(program: Program, every: bool) -> str:
    example = next((path for path in program.settings if "." in path), next(iter(program.settings), "name"))
    name = f"--{flag_of(example)} is {program.variable(example)}"
    return format_help(program.prog, program.model, program.settings, name, every=every)


def _read_environment(environ: Mapping[str, str], program: Program) -> Layer:
    layer = Layer()
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


def _check_use(file: str, program: Program) -> None:
    """Raise ConfigError if a file that was given to this program has a table of another, or nothing for this one."""
    content = read_toml(Path(file))
    own = {path.split(".")[0] for path in program.settings if "." in path} & set(TABLES) | {program.section}
    reads = f"{program.prog} reads {', '.join(f'[{table}]' for table in TABLES if table in own)}"
    allowed = own | (set(RUN_TABLES) if own & set(RUN_TABLES) else set())
    for table in content:
        if table in TABLES and table not in allowed:
            raise ConfigError(f"[{table}] in {file} is not used: {reads}")
    if not own & set(RUN_TABLES):  # a file of a run has shared settings for others
        for key in content.keys() & set(SHARED) - program.settings.keys():
            raise ConfigError(f"{key} in {file} is not used: {reads}")
    known = content.keys() & {*TABLES, *SHARED}  # read_file names the others
    if known == content.keys() != set() and not known & (own | program.settings.keys()):
        raise ConfigError(f"nothing in {file} is used: {reads}; got {', '.join(sorted(content))}")


def read_file(file: str, program: Program) -> Layer:
    """Return the values of a settings file. Raises ConfigError for a key that no program has."""
    settings, section = program.settings, program.section
    content = read_toml(Path(file))
    layer = Layer()
    for key, value in content.items():
        if key in TABLES:
            if not isinstance(value, dict):
                raise ConfigError(f"{key} in {file} is {value!r}; allowed: a table [{key}]")
            continue
        if key not in SHARED:
            raise ConfigError(_without_table(key, value, program, file))
        if key in settings:
            layer.put(key, value, file)
    nested = {path.split(".")[0] for path in settings if "." in path} & set(TABLES)
    tables = [(f"{table}.", content.get(table, {})) for table in sorted(nested)]
    for parent, table in [*tables, ("", content.get(section, {}))]:
        for path, value in _leaves(table, settings, parent):
            if not parent and is_rooted(path):
                root = path.split(".")[0]
                raise ConfigError(
                    f"unknown key {section}.{path} in {file}; allowed: a table [{root}] of its own"
                )
            if path not in settings:
                raise ConfigError(_unknown_key(path, program, file))
            layer.put(path, value, file)
    return layer


def read_toml(file: Path) -> dict[str, Any]:
    """Return the content of a settings file. Raises ConfigError if it can't be read or is not TOML."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"can't read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # not TOML, no text, or beyond Python's limits
        raise ConfigError(f"{file} is not TOML: {error}") from error


def _without_table(key: str, value: Any, program: Program, file: str) -> str:
    """Return what is wrong with a key at the top of a file that belongs into a table, or that there is not."""
    names = [program.name(path).split(".") for path in program.settings]
    if isinstance(value, dict):
        found = {".".join(name[: name.index(key) + 1]) for name in names if key in name[1:-1]}
        if found:
            return f"unknown table [{key}] in {file}; did you mean {_tables(found)}?"
    elif homes := {".".join(name[:-1]) for name in names if name[-1] == key}:
        return f"{key} in {file} stands in no table; allowed: under {_tables(homes)}"
    return f"unknown key {key!r} in {file}{_suggestion(key, [*TABLES, *SHARED])}"


def _tables(names: set[str]) -> str:
    return " or ".join(f"[{name}]" for name in sorted(names))


def _unknown_key(path: str, program: Program, file: str) -> str:
    full = program.name(path)
    parent, _, name = full.rpartition(".")
    group = path.rpartition(".")[0]
    siblings = {
        known.removeprefix(f"{group}." if group else "").split(".")[0]
        for known in program.settings
        if not group or known.startswith(f"{group}.")
    }
    prefix = f"{group}." if group else ""
    deeper = [known for known in program.settings if known.startswith(prefix) and known.endswith(f".{name}")]
    if deeper:
        return f"unknown key {parent}.{name!r} in {file}; did you mean {program.name(deeper[0])!r}?"
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


def _setting_at(location: Sequence[str], program: Program) -> str:
    """Return the setting that an error's location is in, or ""."""
    starts = (".".join(location[:n]) for n in range(len(location), 0, -1))
    return next((path for path in starts if path in program.settings), "")


def flag_of(path: str) -> str:
    """Return a setting's flag without its dashes."""
    return path.replace("_", "-")


def _suggestion(name: str, known: Sequence[str]) -> str:
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {nearest[0]!r}?" if nearest else f"; allowed: {', '.join(sorted(known))}"


def first_line(error: ValidationError, layers: Sequence[Layer], program: Program) -> str:
    """Return one line about the first error."""
    errors = error.errors(include_url=False)
    first = errors[0]
    # without "settings", the name of the merged field
    locations = [tuple(str(part) for part in one["loc"][1:]) for one in errors]
    paths = [_setting_at(location, program) for location in locations]
    location, path = locations[0], paths[0]
    # A setting of several types has an error for each of them
    wrong = {path or location for path, location in zip(paths, locations, strict=True)}
    more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
    if not path:
        where = program.name(".".join(location)) if location else program.section
        return f"{where}: {first['msg'].removeprefix('Value error, ')}{more}"
    origin = next((layer.origins[path] for layer in layers if path in layer.origins), "default")
    allowed = program.settings[path].allowed
    if first["type"] == "missing":
        return f"--{flag_of(path)} must be given; allowed: {allowed}{more}"
    return f"{program.name(path)} = {first['input']!r} ({origin}); allowed: {allowed}{more}"
