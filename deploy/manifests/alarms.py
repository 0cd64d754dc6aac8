"""All alarms in one table, and Prometheus' rules that are made from it.

On a healthy run every signal has data and no alarm fires; a test asks a real Prometheus for both.
"""

from dataclasses import dataclass
from typing import Final, Literal

from common.service.member import LEARNER_ID

WAIT_SHARE: Final = "topspin_learner_wait_share"
"""Name of the learner's hunger, which a rule records, and by which actors can be scaled."""
LEADER: Final = f'role="learner",id="{LEARNER_ID}"'
"""Labels of the learner that leads: of a group, it counts the frames of all."""
WAIT_SHARE_QUERY: Final = f'1 - rate(topspin_phase_seconds_total{{{LEADER},phase="update"}}[2m])'


@dataclass(frozen=True, slots=True)
class Alarm:
    """A condition that somebody should look at."""

    name: str
    signal: str  # PromQL; has data on every run
    condition: str  # the alarm stands while it holds, such as "> 0"
    wait: str  # ... for so long
    severity: Literal["critical", "warning"]  # critical: the run makes no progress, or can't keep it
    summary: str
    action: str

    @property
    def expression(self) -> str:
        """PromQL that has data while the condition holds."""
        return f"{self.signal} {self.condition}"


ALARMS: Final = (
    Alarm(
        "TopspinServiceDown",
        'up{job="topspin"}',
        "== 0",
        "1m",
        "critical",
        "nothing answers at this service's /metrics",
        "The process has ended, or its host can't be reached. Its log has the reason in its last line.",
    ),
    Alarm(
        "TopspinServiceHangs",
        "time() - topspin_heartbeat_time_seconds",
        "> 180",
        "0s",
        "critical",
        "the service answers, but has sent no heartbeat for three minutes",
        "Start it again. An actor that compiles its kernels is silent for about a minute, on a busy core for longer.",
    ),
    Alarm(
        "TopspinNoActors",
        'topspin_alive{service="actor"}',
        "< 1",
        "2m",
        "critical",
        "the learner sees no actor",
        "Start actors with the learner's run and endpoint; their logs say what they wait for.",
    ),
    Alarm(
        "TopspinNotTraining",
        f"rate(topspin_frames_total{{{LEADER}}}[5m])",
        "== 0",
        "5m",
        "critical",
        "nothing has been trained for ten minutes",
        "The learner's log says what it waits for: actors, rollouts, or a contract that fits.",
    ),
    Alarm(
        "TopspinNotSaved",
        "time() - topspin_checkpoint_time_seconds",
        "> 180",
        "1m",
        "critical",
        "the newest checkpoint is older than three minutes",
        "Nothing is trained, or the run folder can't be written. A longer --learner.checkpoint-interval-s needs a "
        "larger limit here.",
    ),
    Alarm(
        "TopspinSavesFail",
        "increase(topspin_failed_saves_total[10m])",
        "> 0",
        "0s",
        "critical",
        "a checkpoint could not be written",
        "Make room on the disk of the run folder. Training goes on, and the next save is tried in its time.",
    ),
    Alarm(
        "TopspinRolloutsLost",
        'delta(topspin_ledger_rollouts{fate="lost"}[10m])',
        "> 0",
        "0s",
        "warning",
        "rollouts were lost",
        "An actor or the learner was killed. Once is no harm: look for the reason if it repeats.",
    ),
    Alarm(
        "TopspinDiverged",
        "increase(topspin_rollbacks_total[30m])",
        "> 0",
        "0s",
        "warning",
        "training diverged and went back to a good checkpoint",
        "If it repeats, lower --learner.ppo.learning-rate-max.",
    ),
    Alarm(
        "TopspinActorsLag",
        "avg_over_time(topspin_policy_lag[5m])",
        "> 1.5",
        "5m",
        "warning",
        "datasets are from policies that are more than 1.5 versions old",
        "Links or actors are slow. Fewer environments for each actor make shorter rollouts.",
    ),
    Alarm(
        "TopspinRolloutsTooOld",
        'increase(topspin_rollouts_received_total{verdict="too_old"}[10m])',
        "> 0",
        "0s",
        "warning",
        "rollouts above --learner.intake.max-lag were refused",
        "An actor is far slower than the others, or was paused.",
    ),
    Alarm(
        "TopspinMisfitActors",
        "topspin_misfit_actors",
        "> 0",
        "1m",
        "warning",
        "actors of other settings get no credits",
        "The learner's log names them. Give them the run's config.toml.",
    ),
    Alarm(
        "TopspinMessagesRefused",
        "sum without (kind) (increase(topspin_messages_refused_total[10m]))",
        "> 0",
        "0s",
        "warning",
        "messages could not be used",
        "The log of the service has the reason: another release, other settings, or a stranger at the hub.",
    ),
    Alarm(
        "TopspinNoRallies",
        "increase(topspin_rally_underruns_total[10m])",
        "> 0",
        "5m",
        "warning",
        "an actor plays random launches, because it has no valid rallies",
        "Add generators, or raise --generator.rate-hz.",
    ),
    Alarm(
        "TopspinLinkUnstable",
        "increase(topspin_reconnects_total[10m])",
        "> 3",
        "0s",
        "warning",
        "the link to the hub breaks again and again",
        "Look at the network between the service and the hub, and at the hub's load.",
    ),
    Alarm(
        "TopspinFilesRunOut",
        "process_open_fds / process_max_fds",
        "> 0.8",
        "1m",
        "warning",
        "more than 80 % of the allowed files and sockets are open",
        "Raise the limit of open files (ulimit -n, LimitNOFILE) where very many actors have one hub.",
    ),
)


def rules() -> dict[str, object]:
    """Return the file of rules."""
    alerts = [
        {
            "alert": alarm.name,
            "expr": alarm.expression,
            **({"for": alarm.wait} if alarm.wait != "0s" else {}),
            "labels": {"severity": alarm.severity},
            "annotations": {
                "summary": f"run {{{{ $labels.run }}}}, {{{{ $labels.role }}}}-{{{{ $labels.id }}}}: {alarm.summary}",
                "description": alarm.action,
            },
        }
        for alarm in ALARMS
    ]
    hunger = {"record": WAIT_SHARE, "expr": WAIT_SHARE_QUERY}
    return {
        "groups": [
            {"name": "topspin", "interval": "15s", "rules": [hunger, *alerts]},
        ]
    }


def markdown() -> str:
    """Return the table as a document."""
    lines = [
        "# Alarms",
        "",
        "The rules of `deploy/monitoring/alerts.yml`. *Critical*: the run makes no progress, or can't keep it.",
        "Generated by `python -m topspin.reference` from `deploy/manifests/alarms.py`.",
        "",
        "| alarm | fires when | what to do |",
        "|---|---|---|",
    ]
    for alarm in ALARMS:
        wait = f", for {alarm.wait}" if alarm.wait != "0s" else ""
        lines.append(
            f"| `{alarm.name}`, {alarm.severity} | {alarm.summary}: `{alarm.expression}`{wait} | {alarm.action} |"
        )
    return "\n".join(lines) + "\n"
