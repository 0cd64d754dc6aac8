"""All generated files of deploy/monitoring and deploy/cluster, by path."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import yaml

from deploy.manifests import alarms, compose, hosts, kubernetes, panels
from deploy.manifests.site import settings, yaml_head

FOLDER: Final = Path(__file__).parents[1]


def files() -> dict[str, str]:
    """Return the content of each generated file by its path in `FOLDER`."""
    return {
        "monitoring/prometheus.yml": _yaml(
            "Prometheus, for runs on its own machine and for compose.yaml.", prometheus()
        ),
        "monitoring/alerts.yml": _yaml("Alarms of a run, and the learner's hunger.", alarms.rules()),
        "monitoring/dashboard.json": json.dumps(panels.dashboard(), indent=1) + "\n",
        "monitoring/grafana/source.yml": _yaml("Grafana's source of data.", _source()),
        "monitoring/grafana/dashboards.yml": _yaml("Where Grafana finds dashboards.", _dashboards()),
        "cluster/compose.yaml": _yaml("A run in containers on one host.", compose.compose()),
        "cluster/config.toml": settings(compose.endpoint()),
        "cluster/targets.json": json.dumps(compose.targets(), indent=1) + "\n",
        "cluster/topspin.slurm.sh": hosts.slurm(),
        **{f"cluster/systemd/{name}": text for name, text in hosts.units().items()},
        **_kubernetes("base", kubernetes.base()),
        **_kubernetes("tls", kubernetes.tls()),
    }


def prometheus() -> dict[str, Any]:
    """Return Prometheus' settings. Labels that a service gives itself win, so that none is called exported_run.

    A pattern may be in the last part of a path only, so it can't be runs/*/targets.json.
    """
    return {
        "global": {"scrape_interval": "5s", "evaluation_interval": "15s"},
        "rule_files": ["alerts.yml"],
        "scrape_configs": [
            {
                "job_name": "topspin",
                "honor_labels": True,
                "file_sd_configs": [
                    {"files": ["../../runs/latest/targets.json", "targets/*.json"], "refresh_interval": "5s"}
                ],
            }
        ],
    }


def _source() -> dict[str, Any]:
    source = {
        "name": "Prometheus",
        "type": "prometheus",
        "access": "proxy",
        "url": "http://prometheus:9090",
        "isDefault": True,
    }
    return {"apiVersion": 1, "datasources": [source]}


def _dashboards() -> dict[str, Any]:
    folder = {"path": "/var/lib/grafana/dashboards"}
    return {"apiVersion": 1, "providers": [{"name": "topspin", "type": "file", "options": folder}]}


def _kubernetes(folder: str, found: Mapping[str, Any]) -> dict[str, str]:
    return {
        f"cluster/kubernetes/{folder}/{name}": content
        if isinstance(content, str)
        else _yaml(f"Kubernetes, {folder}: {name.removesuffix('.yaml')}.", content)
        for name, content in found.items()
    }


class _Dumper(yaml.SafeDumper):
    """Writes a part again where it is used twice: anchors would be hard to read."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _yaml(what: str, content: Any) -> str:
    documents = content if isinstance(content, list) else [content]
    text = yaml.dump_all(documents, Dumper=_Dumper, sort_keys=False, width=110)
    return yaml_head(what) + text
