"""Settings of a whole run on one machine: the number of processes, and the settings of each."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Final, Literal, Self

from pydantic import Field, model_validator

from common.errors import ConfigError
from common.policy.config import NetworkConfig
from common.service.config import first_look, load, recipe_names
from common.service.config_sources import read_toml
from common.service.endpoint import FIRST_PORT
from common.service.run_folder import LATEST, RunFolder, newest_run
from common.service.settings import LOCAL_ACTORS, MOST_ACTORS, Fleet, RunSettings
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from services.actor.config import ActorOptions
from services.evaluator.config import EvaluatorOptions
from services.generator.config import GeneratorOptions
from services.learner.budget import BudgetConfig
from services.learner.config import LearnerOptions

RECIPES: Final = Path(__file__).with_name("recipes")
SECTION: Final = "local"


class DeployConfig(RunSettings, Fleet, BudgetConfig):
    """Train a policy: start a whole run on this machine, watch its processes, and measure the final policy.

    The run leaves runs/NAME/: settings, curves, checkpoints, policies and logs. Stop it with Ctrl-C, and go on with
    --resume.
    """

    often: ClassVar = {
        "The run": ("run", "recipe", "resume", "actors"),
        "Its end": ("minutes", "frames", "json"),
        "The task": ("task.launch", "task.randomization"),
        "Training": ("learner.curriculum.first_stage", "seed"),
    }

    run: str = Field("", description="name of the run; empty: a time stamp. runs/latest points to it")
    recipe: str = Field(
        "",
        description="settings that a run starts from, in place of the defaults: "
        f"{', '.join(recipe_names(RECIPES))}, or a TOML file; empty: none",
    )
    endpoint: str = Field(
        "",
        pattern=r"^$|^(tcp|tls|unixsock-stream)/.+",
        description="where the learner listens; empty: a free port on this machine",
    )
    actors: int = Field(
        LOCAL_ACTORS,
        ge=1,
        le=MOST_ACTORS,
        description="actors: a dataset is one rollout of each, and they share 256 environments. Two play about what "
        "one learner trains",
    )
    learners: int = Field(
        1,
        ge=1,
        le=64,
        description="learners that train together, each with a core and its share of the actors",
    )
    resume: bool = Field(False, exclude=True, description="go on with runs/RUN from its newest checkpoint")
    metrics_port: int = Field(
        FIRST_PORT,
        ge=0,
        le=64000,
        description="first port of /metrics: learner, evaluator, generators and actors take it and the next ones that "
        "are free; 0: any free ports",
    )
    panel: Literal["auto", "on", "off"] = Field(
        "auto", description="live terminal panel, in place of lines of progress; auto: if there is a terminal"
    )
    json_line: bool = Field(
        False, alias="json", exclude=True, description="print the run's summary as one JSON object, last line"
    )
    watchdog_s: float = Field(
        60.0,
        ge=0,
        description="a process that sends no heartbeat and uses no CPU time for so long hangs, and is restarted; "
        "0: never",
        json_schema_extra={"unit": "s"},
    )
    evaluate: bool = Field(True, description="evaluate while the run trains, and measure the final policy")
    final_rallies: int = Field(1000, ge=1, description="rallies of the final measure")
    task: TaskConfig = TaskConfig()
    experience: ExperienceConfig = ExperienceConfig()
    network: NetworkConfig = NetworkConfig()
    learner: LearnerOptions = LearnerOptions()
    actor: ActorOptions = ActorOptions()
    generator: GeneratorOptions = GeneratorOptions()
    evaluator: EvaluatorOptions = EvaluatorOptions()

    @model_validator(mode="after")
    def _stages_have_a_budget(self) -> Self:
        self.learner.curriculum.check_budget(self.frames)
        return self


def settings(argv: Sequence[str], prog: str) -> DeployConfig:
    """Return the settings of a run; a resumed one has those of its config.toml, except for flags given now."""
    asked = first_look(DeployConfig, ("run", "resume"), argv, prog=prog, section=SECTION)
    if not asked.resume:
        if asked.run == LATEST:
            raise ConfigError(f"run {LATEST!r} is the name of the newest run; choose another --run")
        return load(DeployConfig, argv, prog=prog, section=SECTION, recipes=RECIPES)
    if not asked.run:
        newest = f": the newest run is {found}" if (found := newest_run()) else ""
        raise ConfigError(f"--resume needs --run NAME{newest}")
    name = (newest_run() or LATEST) if asked.run == LATEST else asked.run
    file = RunFolder.of(name).config
    if not file.exists():
        raise ConfigError(f"run {name!r} can't be resumed: there is no {file}")
    own = read_toml(file).get(SECTION)
    if own is None:
        raise ConfigError(
            f"run {name!r} was started service by service: {file} has no table [{SECTION}]; go on with: "
            f"python -m services.learner --run {name} --resume"
        )
    # The file has every setting, those of its recipe too
    resumed = load(DeployConfig, argv, prog=prog, section=SECTION, recorded=file)
    recipe = own.get("recipe", "")
    if resumed.recipe not in ("", recipe):
        raise ConfigError(
            f"--recipe {resumed.recipe} with --resume: run {name!r} started with "
            f"{f'recipe {recipe}' if recipe else 'no recipe'}; allowed: no --recipe"
        )
    return resumed.model_copy(update={"run": name})
