"""What all kinds of manifests have in common: the run they start, its settings, names and ports."""

from dataclasses import dataclass
from typing import Any, Final

from common.service.endpoint import FIRST_PORT
from deploy.topology import Role

IMAGE: Final = "topspin:0.2.0"
LINK_PORT: Final = 7447
USER: Final = 10001  # of the containers: any that is not root
SETTINGS: Final = "/etc/topspin/config.toml"
CERTIFICATES: Final = "/etc/topspin-tls"  # not inside the settings: a volume of those can hold no mount
WORK: Final = "/var/lib/topspin"  # working folder; holds runs/
CACHE: Final = "/var/cache/topspin"  # compiled kernels
HUNGER: Final = 0.3  # share of the learner's time without data that actors are added above


@dataclass(frozen=True, slots=True)
class Site:
    """Sizes of the example run: what people change first."""

    run: str = "cluster"
    actors: int = 8
    fewest_actors: int = 2
    generators: int = 1
    evaluate: bool = True


SITE: Final = Site()
ROUTER: Final = (
    *("deploy.router", "--endpoint", f"tcp/0.0.0.0:{LINK_PORT}"),
    *("--run", SITE.run, "--metrics-host", "0.0.0.0", "--metrics-port", str(FIRST_PORT)),
)
ROUTER_GRACE_S: Final = 10


def settings(endpoint: str, tls: bool = False) -> str:
    """Return the run's config.toml."""
    folder = f'tls = "{CERTIFICATES}"\n' if tls else ""
    return (
        "# The settings of every service of the run. `topspin train --help-all` lists all of them.\n"
        f'run = "{SITE.run}"\n'
        f"actors = {SITE.actors}  # at most: they share 256 environments, and a dataset is as many rollouts\n"
        f"generators = {SITE.generators}\n"
        f'endpoint = "{endpoint}"\n'
        f"{folder}"
        'metrics_host = "0.0.0.0"\n'
    )


def command(role: Role, index: str, is_hub: bool = False) -> list[str]:
    """Return module and flags of a service in a container."""
    more: tuple[str, ...] = ()
    if role.name == "learner":
        more = ("--auto-resume", "--mode", "hub" if is_hub else "client")
    return list(role.arguments(index, SETTINGS, str(FIRST_PORT), *more))


def yaml_head(what: str) -> str:
    """Return the comment that starts a generated file."""
    return f"# {what}\n# Written by `python -m deploy.manifests`: change its tables, not this file.\n"


def probe(path: str, period_s: int, failures: int) -> dict[str, Any]:
    """Return a probe of Kubernetes on a path of the metrics port."""
    return {
        "httpGet": {"path": path, "port": "metrics"},
        "periodSeconds": period_s,
        "timeoutSeconds": 5,
        "failureThreshold": failures,
    }
