"""Settings of an actor."""

from typing import ClassVar, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from common.policy.config import NetworkConfig
from common.service.settings import Fleet, ServiceConfig
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig

ENVS: Final = 256  # environments that the actors of a run share
FEWEST_ENVS: Final = 16  # of each actor
IDLE_WAIT_S: Final = 0.05  # between two looks for messages, while an actor waits


class OutboxConfig(BaseModel):
    """How an actor sends and retries."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    window: int = Field(2, ge=1, le=2, description="rollouts that may be in flight at once")
    request_timeout_s: float = Field(
        10.0, gt=0, description="wait for a verdict before the next try", json_schema_extra={"unit": "s"}
    )
    retry_first_s: float = Field(
        0.1, gt=0, description="pause before the first retry; doubles", json_schema_extra={"unit": "s"}
    )
    retry_max_s: float = Field(
        5.0, gt=0, description="longest pause between retries", json_schema_extra={"unit": "s"}
    )
    give_up_s: float = Field(
        86_400.0, gt=0, description="age at which a rollout is dropped", json_schema_extra={"unit": "s"}
    )


class ActorOptions(BaseModel):
    """How an actor plays and sends."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    outbox: OutboxConfig = OutboxConfig()
    envs: int = Field(
        0,
        ge=0,
        le=65536,
        description=f"environments of each actor, played together; 0: the actors share {ENVS}, at least "
        f"{FEWEST_ENVS} each (more than {ENVS // FEWEST_ENVS} actors make larger datasets)",
    )
    horizon: int = Field(32, ge=1, le=4096, description="control steps of one rollout")
    rallies: Literal["subscribe", "ask"] = Field(
        "subscribe",
        description="subscribe: take the rallies that are published; ask: request each block by index and wait for it "
        "(reproducible bit for bit)",
    )
    rally_wait_s: float = Field(
        10.0, gt=0, description="wait for a requested block", json_schema_extra={"unit": "s"}
    )
    silence_warning_s: float = Field(
        10.0,
        gt=0,
        description="idle time after which the log says what the actor waits for",
        json_schema_extra={"unit": "s"},
    )
    history: str = Field(
        "", description="folder for a history: a line for each event of a rollout; empty: none"
    )


class ActorConfig(ServiceConfig, Fleet, ActorOptions):
    """Play rallies with the newest policy and send the rollouts to the learner.

    With --run and --endpoint alone the learner says what else there is to know. [task], [network] and [experience] must
    be the learner's, otherwise the actor refuses its policies.
    """

    often: ClassVar = {
        "The run": ("run", "endpoint", "id", "index", "actors", "metrics_port"),
        "Play": ("envs", "task.launch", "task.randomization", "seed"),
    }

    index: int = Field(
        -1,
        ge=-1,
        exclude=True,
        description="number of this actor, from 0; decides its action noise and its rally shard. -1: the learner gives "
        "it, and with it the id and the settings that are not given here",
    )
    task: TaskConfig = TaskConfig()
    network: NetworkConfig = NetworkConfig()
    experience: ExperienceConfig = ExperienceConfig()

    @property
    def number(self) -> int:
        """The number of this actor, from 0."""
        return max(self.index, 0)

    @property
    def env_count(self) -> int:
        """How many environments this actor plays."""
        return env_count(self.envs, self.actors)


def env_count(envs: int, actors: int) -> int:
    """Return how many environments each of so many actors plays, by the setting ``envs``."""
    return envs or max(FEWEST_ENVS, ENVS // actors)
