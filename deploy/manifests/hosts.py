"""Runs on hosts without containers: systemd units, and a job for Slurm."""

from typing import Final

from common.service.endpoint import FIRST_PORT
from deploy.manifests.site import LINK_PORT, SITE, WORK, yaml_head
from deploy.topology import ROLES, Role

INSTALL: Final = "/opt/topspin/.venv/bin/python"
_EACH: Final = {"learner": "the host that others connect to", "actor": "any host: one for each core"}


def units() -> dict[str, str]:
    """Return the systemd units by file name: a template for each role, and a target for all of a host."""
    found = {f"topspin-{role.name}@.service": _unit(role) for role in ROLES}
    found["topspin.target"] = (
        yaml_head("All services of Topspin on this host; each is enabled by itself.")
        + "[Unit]\nDescription=Topspin\n\n[Install]\nWantedBy=multi-user.target\n"
    )
    return found


def _unit(role: Role) -> str:
    arguments = role.arguments("%i", "/etc/topspin/config.toml", str(FIRST_PORT))
    flags = " \\\n    ".join([f"-m {arguments[0]}", *_pairs(arguments[1:]), *_hub_flags(role)])
    needs = role.resources
    restart = "on-failure" if role.name == "learner" else "always"  # the learner ends when the run is done
    return (
        yaml_head(f"Topspin: {role.name} %i {role.summary}. For {_EACH.get(role.name, 'any host')}.")
        + f"""\
[Unit]
Description=Topspin {role.name} %i: {role.summary}
After=network-online.target
Wants=network-online.target
PartOf=topspin.target
StartLimitIntervalSec=600
StartLimitBurst=5

[Service]
ExecStart={INSTALL} {flags}
WorkingDirectory={WORK}
StateDirectory=topspin
CacheDirectory=topspin
Environment=XDG_CACHE_HOME=/var/cache/topspin OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
DynamicUser=yes
User=topspin
Restart={restart}
RestartSec=2
RestartPreventExitStatus=2
TimeoutStopSec={role.grace_s}
MemoryHigh={needs.memory_mib * 2}M
MemoryMax={needs.memory_limit_mib}M
LimitNOFILE=65536
NoNewPrivileges=yes
PrivateTmp=yes
PrivateDevices=yes
ProtectSystem=strict
ProtectHome=yes
ProtectKernelTunables=yes
ProtectControlGroups=yes
RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK
CapabilityBoundingSet=

[Install]
WantedBy=topspin.target
"""
    )


def _pairs(words: tuple[str, ...]) -> list[str]:
    return [" ".join(words[i : i + 2]) for i in range(0, len(words), 2)]


def _hub_flags(role: Role) -> list[str]:
    """Return what makes the learner the hub of the hosts: it listens at every address."""
    return ["--auto-resume", f"--endpoint tcp/0.0.0.0:{LINK_PORT}"] if role.name == "learner" else []


def slurm() -> str:
    """Return a job script: learner, evaluator and generators on the first node, actors on all."""
    first = "\n".join(_background(role) for role in ROLES if role.name != "actor")
    actor = _line(next(role for role in ROLES if role.name == "actor"), "$SLURM_PROCID")
    return (
        "#!/bin/bash\n"
        + yaml_head("Slurm: one run. Submit with: sbatch --ntasks 16 deploy/cluster/topspin.slurm.sh NAME")
        + f"""\
#SBATCH --job-name=topspin
#SBATCH --ntasks={SITE.actors}
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=2G
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@120
#SBATCH --requeue
# Learner, evaluator and generators share the first node with its actors: ask for nodes with 4 cores more than
# actors. When the time is up, or the job is put back into the queue, the next one goes on where this one ended.
set -euo pipefail

run=${{1:?usage: sbatch topspin.slurm.sh NAME}}
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
python=${{PYTHON:-python}} # not TOPSPIN_...: those are settings
folder=runs/$run # on a file system that all nodes see
settings=$folder/slurm.toml
mkdir -p "$folder/logs"
cat >"$settings" <<END
run = "$run"
endpoint = "tcp/$(hostname):{LINK_PORT}"
actors = $SLURM_NTASKS
generators = {SITE.generators}
metrics_host = "0.0.0.0"
END

workers=()
{first}
# shellcheck disable=SC2016 # each task has its own number
srun --overlap --kill-on-bad-exit=0 --output="$folder/logs/actor-%t.log" \\
    bash -c 'exec "$0" -m {actor}' "$python" "$settings" &
workers+=($!)

# The learner ends when its budget is spent; SIGTERM comes two minutes before the end of the job's time.
trap 'kill -TERM "$learner" 2>/dev/null || true' TERM INT
status=0
wait "$learner" || status=$?
while kill -0 "$learner" 2>/dev/null; do # a signal has ended the wait, not the learner
    status=0
    wait "$learner" || status=$?
done
kill -TERM "${{workers[@]}}" 2>/dev/null || true
wait "${{workers[@]}}" 2>/dev/null || true
exit "$status"
"""
    )


def _line(role: Role, index: str, file: str = '"$1"') -> str:
    return " ".join(role.arguments(index, file, str(FIRST_PORT)))


def _background(role: Role) -> str:
    more = f' --auto-resume --endpoint "tcp/0.0.0.0:{LINK_PORT}"' if role.name == "learner" else ""
    lines = []
    for index in range(role.count(SITE)):
        line = _line(role, str(index), '"$settings"')
        lines.append(f'"$python" -m {line}{more} >>"$folder/logs/{role.name}-{index}.log" 2>&1 &')
        lines.append("learner=$!" if role.name == "learner" else "workers+=($!)")
    return "\n".join(lines)
