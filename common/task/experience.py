"""How training plays the task: when episodes end or continue, the way home, and the teacher."""

from typing import Final

from pydantic import BaseModel, ConfigDict, Field


class TeacherConfig(BaseModel):
    """A teacher: a policy that a new one imitates in its first epochs.

    The student acts, and the teacher gives the action that it would take in the same situation: DAgger (Ross, Gordon,
    Bagnell 2011). The teacher may observe more than the student.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    policy: str = Field(
        "",
        description="the teacher: name of a policy in the box, or a folder with the same path for learner and actors; "
        "empty: no teacher",
    )
    epochs: int = Field(
        600,
        ge=1,
        description="first epochs of a run, in which the policy imitates the teacher; then it learns from rewards",
        json_schema_extra={"unit": "datasets"},
    )
    target_shrink: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="share of the way to the court's middle by which the teacher's targets are moved: a student that "
        "observes less has larger errors and should aim farther inside",
    )

    def teaches(self, version: int) -> bool:
        """Return whether the policy of this version, one an epoch, still imitates the teacher."""
        return bool(self.policy) and version < self.epochs


class ExperienceConfig(BaseModel):
    """How training plays the task. No setting here changes what a match measures."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    continue_share: float = Field(
        0.4, ge=0, le=1, description="share of episodes that continue with a second rally after a return"
    )
    end_at_hit_share: float = Field(
        0.8,
        ge=0,
        le=1,
        description="share of episodes that end when the ball is hit: its flight is simulated to the landing and paid "
        "at once",
    )
    leads_home: bool = Field(
        True,
        description="in stage 3 lead the robot home after each hit: the next ball finds it where this one left it",
    )
    teacher: TeacherConfig = TeacherConfig()


MATCH: Final = ExperienceConfig(continue_share=0.0, end_at_hit_share=0.0, leads_home=False)
"""How a match plays: every rally to its end, without a teacher."""
