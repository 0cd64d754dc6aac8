"""compose.yaml: a run in containers of one host, with a router, Prometheus and Grafana."""

from typing import Any, Final

from common.service.endpoint import FIRST_PORT
from deploy.manifests.site import CACHE, IMAGE, LINK_PORT, ROUTER, ROUTER_GRACE_S, SITE, USER, WORK, command
from deploy.topology import ROLES, Role

PROMETHEUS: Final = "prom/prometheus:v3.5.0"
GRAFANA: Final = "grafana/grafana:12.1.0"
_MONITORING: Final = "../monitoring"


def endpoint() -> str:
    """Return where the services find each other."""
    return f"tcp/router:{LINK_PORT}"


def compose() -> dict[str, Any]:
    """Return the file."""
    services: dict[str, Any] = {"router": _hardened(list(ROUTER), 0.5, 512, ROUTER_GRACE_S)}
    for role in ROLES:
        for index in range(role.count(SITE)):
            services[f"{role.name}-{index}"] = _service(role, index)
    services |= {"prometheus": _prometheus(), "grafana": _grafana()}
    return {
        "name": "topspin",
        "services": services,
        "volumes": {"work": {}, "prometheus": {}, "grafana": {}},
        "configs": {"settings": {"file": "./config.toml"}},
    }


def targets() -> list[dict[str, Any]]:
    """Return where Prometheus finds the services of this file."""
    names = [("router", "0", "router")]
    names += [(role.name, str(i), f"{role.name}-{i}") for role in ROLES for i in range(role.count(SITE))]
    return [
        {"targets": [f"{host}:{FIRST_PORT}"], "labels": {"run": SITE.run, "role": role, "id": id_}}
        for role, id_, host in names
    ]


def _hardened(arguments: list[str], cores: float, memory_mib: int, grace_s: int) -> dict[str, Any]:
    return {
        "image": IMAGE,
        "build": {"context": "../..", "dockerfile": "deploy/cluster/Dockerfile"},
        "command": arguments,
        "user": f"{USER}:{USER}",
        "read_only": True,
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
        "tmpfs": [f"/tmp:uid={USER}", f"{CACHE}:uid={USER}"],
        "init": True,
        "restart": "unless-stopped",
        "stop_grace_period": f"{grace_s}s",
        "cpus": cores,
        "mem_limit": f"{memory_mib}m",
        "healthcheck": {
            "test": ["CMD", "python", "-m", "deploy.ask", f"http://127.0.0.1:{FIRST_PORT}/healthz"],
            "interval": "30s",
            "timeout": "10s",
            "retries": 6,
            "start_period": "300s",
        },
    }


def _service(role: Role, index: int) -> dict[str, Any]:
    needs = role.resources
    found = _hardened(command(role, str(index)), needs.cores_limit, needs.memory_limit_mib, role.grace_s)
    if role.name == "learner":
        found["restart"] = "on-failure"  # it ends when the run is done
    found["depends_on"] = ["router"]
    found["configs"] = [{"source": "settings", "target": "/etc/topspin/config.toml"}]
    if role.keeps_files:
        found["volumes"] = [f"work:{WORK}"]
    return found


def _prometheus() -> dict[str, Any]:
    return {
        "image": PROMETHEUS,
        "command": ["--config.file=/etc/prometheus/prometheus.yml", "--storage.tsdb.retention.time=30d"],
        "ports": ["127.0.0.1:9090:9090"],
        "volumes": [
            f"{_MONITORING}/prometheus.yml:/etc/prometheus/prometheus.yml:ro",
            f"{_MONITORING}/alerts.yml:/etc/prometheus/alerts.yml:ro",
            "./targets.json:/etc/prometheus/targets/cluster.json:ro",
            "prometheus:/prometheus",
        ],
        "restart": "unless-stopped",
    }


def _grafana() -> dict[str, Any]:
    return {
        "image": GRAFANA,
        "ports": ["127.0.0.1:3000:3000"],
        "volumes": [
            f"{_MONITORING}/grafana/source.yml:/etc/grafana/provisioning/datasources/topspin.yml:ro",
            f"{_MONITORING}/grafana/dashboards.yml:/etc/grafana/provisioning/dashboards/topspin.yml:ro",
            f"{_MONITORING}/dashboard.json:/var/lib/grafana/dashboards/topspin.json:ro",
            "grafana:/var/lib/grafana",
        ],
        "depends_on": ["prometheus"],
        "restart": "unless-stopped",
    }
