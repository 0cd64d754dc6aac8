"""Settings of a whole run on one machine: every process's, and how many there are."""

from collections.abc import Iterable, Mapping, Set
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from common.comms.zenoh_config import ZenohConfig
from common.config import ConfigError
from common.env.rally_env import EnvConfig
from common.policy.actor_critic import NetworkConfig
from common.rally.launch_presets import PresetName
from services.actor.config import ActorConfig
from services.evaluator.config import EvaluatorConfig
from services.generator.config import GeneratorConfig
from services.learner.config import LearnerConfig
from services.learner.intake import IntakeConfig


class SharedActorConfig(ActorConfig):
    """Settings of each actor of a run."""

    envs: int = Field(
        0,
        ge=0,
        le=65536,
        description="environments of each actor; 0: the actors share 256, and have 16 each at least",
    )


class SharedIntakeConfig(IntakeConfig):
    """How much data an update takes, and how old it may be."""

    dataset_rollouts: int = Field(0, ge=0, description="rollouts of one dataset; 0: one of each actor")


class SharedLearnerConfig(LearnerConfig):
    """Settings of the learner of a run."""

    intake: SharedIntakeConfig = SharedIntakeConfig()


class DeployConfig(BaseModel):
    """Settings of a run; task, network, launch preset and seed are given once and handed to every process."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    run: str = Field("", description="name of the run; empty: a time stamp. runs/latest points to it")
    actors: int = Field(
        1,
        ge=1,
        le=1000,
        description="actor processes; they share 256 environments (16 each at least: more than 16 actors make larger "
        "datasets, and the stages, which count datasets, longer), or have --actor.envs each. The learner keeps a core "
        "busy of its own",
    )
    generators: int = Field(1, ge=1, le=100, description="generator processes")
    shards: int = Field(0, ge=0, le=4096, description="rally shards; 0: as many as actors")
    minutes: float = Field(
        0.0,
        ge=0,
        description="stop this long after the first trained batch, counted through restarts; 0: the whole curriculum",
        json_schema_extra={"unit": "min"},
    )
    frames: int = Field(
        0, ge=0, description="stop after this many trained frames, counted through restarts; 0: no limit"
    )
    resume: bool = Field(False, description="go on with runs/RUN from its newest checkpoint")
    endpoint: str = Field(
        "",
        pattern=r"^$|^(tcp|tls|unixsock-stream)/.+",
        description="where the learner listens; empty: a free port on this machine",
    )
    tls_ca: str = Field("", description="file with the authority's certificate; given = mutual TLS")
    tls_certificate: str = Field("", description="file with this machine's certificate")
    tls_key: str = Field("", description="file with this machine's private key")
    metrics_port: int = Field(
        0, ge=0, le=64000, description="first port of /metrics, one up for each process; 0: any free ones"
    )
    panel: Literal["auto", "on", "off"] = Field(
        "auto", description="live terminal panel; auto: if there is a terminal"
    )
    evaluate: bool = Field(True, description="follow the run with an evaluator, and measure the final policy")
    final_rallies: int = Field(1000, ge=1, description="rallies of the final measure")
    seed: int = Field(0, ge=0, lt=2**63, description="of everything random in the run")
    launch: PresetName = Field("paper", description="launch preset of training")
    env: EnvConfig = EnvConfig()
    network: NetworkConfig = NetworkConfig()
    learner: SharedLearnerConfig = SharedLearnerConfig()
    actor: SharedActorConfig = SharedActorConfig()
    generator: GeneratorConfig = GeneratorConfig()
    evaluator: EvaluatorConfig = EvaluatorConfig()


CONNECT_S: Final = 60.0  # for the learner to listen
ENVS: Final = ActorConfig().envs  # of one actor that works alone
FEWEST_ENVS: Final = 16


def shared_out(config: DeployConfig) -> DeployConfig:
    """Return ``config`` with its datasets made of one rollout of each actor, which share one actor's environments.

    So a dataset is as large with up to 16 of them. What was asked for stays.
    """
    envs = config.actor.envs or max(FEWEST_ENVS, ENVS // config.actors)
    rollouts = config.learner.intake.dataset_rollouts or config.actors
    # A queue that can't hold a dataset would be the end of training.
    queue = max(config.learner.intake.queue_rollouts, 2 * rollouts)
    return _dealt(config, envs, {"dataset_rollouts": rollouts, "queue_rollouts": queue})


def shared_again(config: DeployConfig, recorded: DeployConfig, given: Set[str]) -> DeployConfig:
    """Return a resumed run's settings, to be shared out anew where they were when it began.

    Releases before this one wrote down what each actor got, not that nobody had asked for it: so a number that is
    what that many actors get is taken for it.

    Args:
        config: What the run goes on with.
        recorded: What its file says.
        given: Dotted paths of what flags and environment say.
    """
    usual = shared_out(DeployConfig(actors=recorded.actors))
    envs, rollouts = config.actor.envs, config.learner.intake.dataset_rollouts
    if "actor.envs" not in given and recorded.actor.envs == usual.actor.envs:
        envs = 0
    if (
        "learner.intake.dataset_rollouts" not in given
        and recorded.learner.intake.dataset_rollouts == usual.learner.intake.dataset_rollouts
    ):
        rollouts = 0
    return _dealt(config, envs, {"dataset_rollouts": rollouts})


def _dealt(config: DeployConfig, envs: int, intake: Mapping[str, int]) -> DeployConfig:
    learner = config.learner.model_copy(update={"intake": config.learner.intake.model_copy(update=intake)})
    return config.model_copy(
        update={"actor": config.actor.model_copy(update={"envs": envs}), "learner": learner}
    )


HANDED_DOWN: Final[Mapping[str, Mapping[str, str]]] = {
    "learner": {name: name for name in ("launch", "env", "network", "minutes", "frames", "folder", "mode")},
    "actor": {name: name for name in ("launch", "env", "network", "shards")},
    "generator": {
        "launch": "launch", "noise": "env.noise", "flight": "env.flight", "shards": "shards", "of": "generators",
    },
    "evaluator": {"launch": "launch", "env": "env", "network": "network", "noise": "env.noise", "folder": "folder"},
}  # fmt: skip
"""What a service is told by the run, and which of the run's settings says it; some, only the run knows."""
_TO_ALL: Final = ("run", "endpoint", "tls_ca", "tls_certificate", "tls_key", "seed")
ON_COMMAND_LINE: Final[Mapping[str, str]] = {
    "id": "", "index": "", "metrics_port": "metrics_port", "resume": "resume", "policy": ""
}  # fmt: skip
"""What each process gets, or doesn't, when it is started, and the run's setting behind it ("": none)."""


def way_to_hub(config: DeployConfig, endpoint: str) -> ZenohConfig:
    """Return how the run's own session gets to the learner: as its services do.

    Raises:
        ConfigError: TLS without its three files, or they without it.
    """
    try:
        return ZenohConfig(
            endpoint=endpoint,
            tls_ca=config.tls_ca,
            tls_certificate=config.tls_certificate,
            tls_key=config.tls_key,
            connect_timeout_s=CONNECT_S,
        )
    except ValidationError as error:
        raise ConfigError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None


def given_elsewhere(paths: Iterable[str]) -> dict[str, str]:
    """Return those dotted paths of a run's settings that are handed down, and what to set instead ("": nothing)."""
    found = {}
    to_all = {**{name: name for name in _TO_ALL}, **ON_COMMAND_LINE}
    for path in paths:
        role, _, rest = path.partition(".")
        name, _, inner = rest.partition(".")
        source = to_all.get(name, HANDED_DOWN.get(role, {}).get(name))
        if role in HANDED_DOWN and source is not None:
            known = source.partition(".")[0] in DeployConfig.model_fields
            found[path] = f"{source}.{inner}".rstrip(".") if known else ""
    return found


def service_sections(config: DeployConfig, run: str, endpoint: str, folder: str) -> dict[str, dict[str, Any]]:
    """Return what each role's section of the run's config.toml says: shared settings are written into each."""
    told = {
        "run": run,
        "endpoint": endpoint,
        "tls_ca": config.tls_ca,
        "tls_certificate": config.tls_certificate,
        "tls_key": config.tls_key,
        "folder": folder,
        "mode": "hub",
        "seed": config.seed,
        "launch": config.launch,
        "minutes": config.minutes,
        "frames": config.frames,
        "generators": config.generators,
        "shards": config.shards or config.actors,
        "env": config.env.model_dump(mode="json"),
        "env.noise": config.env.noise,
        "env.flight": config.env.flight,
        "network": config.network.model_dump(mode="json"),
    }
    own = {
        role: {name: told[source] for name, source in sources.items() if source in told}
        for role, sources in HANDED_DOWN.items()
    }
    shared = {name: told[name] for name in _TO_ALL}
    return {
        role: getattr(config, role).model_dump(mode="json", by_alias=True) | shared | values
        for role, values in own.items()
    }
