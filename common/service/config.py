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

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tomli_w
from pydantic import BaseModel, ValidationError, create_model
from pydantic_core import PydanticUndefined, to_jsonable_python
from pydantic_settings import BaseSettings, InitSettingsSource, PydanticBaseSettingsSource

from common.errors import ConfigError, HelpRequest
from common.service.config_help import Setting, settings_of
from common.service.config_sources import (
    SHARED,
    TABLES,
    Layer,
    Program,
    first_line,
    read_file,
    read_sources,
    read_toml,
)
from common.service.whole_file import write_whole

_Model = TypeVar("_Model", bound=BaseModel)


def load(
    model: type[_Model],
    argv: Sequence[str],
    *,
    prog: str,
    section: str,
    environ: Mapping[str, str] | None = None,
    recorded: Path | None = None,
    beneath: Path | None = None,
    recipes: Path | None = None,
) -> _Model:
    """Return the settings of one program.

    Args:
        model: Its fields are the settings.
        argv: Flags, without the program's name.
        prog: How the program is called, for the help text.
        section: The program's table in the file, and its part of the environment's names.
        environ: Environment; the process's by default.
        recorded: File with the settings of a resumed run. Those of ``--config`` go before; the environment's
            ``TOPSPIN_CONFIG`` is not read.
        beneath: File with settings that count where nothing else gives a value.
        recipes: Folder of the recipes that have a name; None: setting ``recipe`` is not followed.

    Raises:
        ConfigError: An unknown or unusable setting.
        HelpRequest: ``--help``, ``--help-all`` or ``--print-config`` is among the flags.
    """
    program = Program(model, settings_of(model), prog, section)
    layers, prints = read_sources(program, argv, environ, recorded, beneath)
    recipe = next((layer.values["recipe"] for layer in layers if "recipe" in layer.values), "")
    if recipes is not None and recipe:
        layers = (*layers, read_file(str(recipe_file(recipe, recipes)), program))
    loaded = _merged(model, (*layers, _nested_defaults(program.settings)), program)
    if prints:
        raise HelpRequest(changes(loaded, program))
    return loaded


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
    program = Program(model, settings_of(model), prog, section)
    some = [
        Layer({name: layer.values[name] for name in names if name in layer.values}, layer.origins)
        for layer in read_sources(program, argv, environ, None)[0]
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


def changes(model: BaseModel, program: Program) -> str:
    """Return the settings that differ from the defaults, as a TOML file that ``--config`` reads."""
    values = model.model_dump(mode="json", by_alias=True, exclude_none=True)
    tables: dict[str, Any] = {}
    for path, setting in program.settings.items():
        *parents, name = path.split(".")
        found = values
        for parent in parents:
            found = found.get(parent, {})
        default = None if setting.default is PydanticUndefined else to_jsonable_python(setting.default)
        if name not in found or found[name] == default:
            continue
        *places, name = [path] if path in SHARED else program.name(path).split(".")
        table = tables
        for place in places:
            table = table.setdefault(place, {})
        table[name] = found[name]
    text = tomli_w.dumps(tables)
    return text or f"# {program.prog}: every setting has its default\n"


def save_settings(file: Path, tables: Mapping[str, Any]) -> None:
    """Replace these settings and tables of a settings file in one step; the others stay.

    Raises:
        ConfigError: The file is not TOML.
    """
    before = read_toml(file) if file.exists() else {}
    text = tomli_w.dumps({**before, **tables})
    write_whole(file, text)  # services that are just starting read it


def _merged(model: type[_Model], layers: Sequence[Layer], program: Program) -> _Model:
    class Layered(BaseSettings):
        @classmethod
        def settings_customise_sources(
            cls, settings_cls: type[BaseSettings], *_: Any, **__: Any
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return tuple(InitSettingsSource(settings_cls, {"settings": layer.values}) for layer in layers)

    try:
        loaded = create_model("Loaded", __base__=Layered, settings=(model, ...))()
    except ValidationError as error:
        raise ConfigError(first_line(error, layers, program)) from error
    merged: _Model = loaded.settings  # type: ignore[attr-defined]  # the field made a line above
    return merged


def _nested_defaults(settings: Mapping[str, Setting]) -> Layer:
    """Return the defaults that a model gives its nested models: setting one field must not reset the others."""
    layer = Layer()
    for path, setting in settings.items():
        if "." in path and setting.default is not PydanticUndefined:
            layer.put(path, setting.default, "default")
    return layer
