"""Kubernetes: a kustomize base of an open run in its own namespace, and an overlay with TLS.

Actors are one Deployment: the learner gives each its number. The other roles are StatefulSets. The number of a pod is
the service's id and index. With TLS it names the certificate, so there the actors are a StatefulSet too.
"""

from typing import Any, Final

from common.service.endpoint import FIRST_PORT
from deploy.manifests.alarms import WAIT_SHARE
from deploy.manifests.site import (
    CACHE,
    CERTIFICATES,
    HUNGER,
    IMAGE,
    LINK_PORT,
    ROUTER,
    ROUTER_GRACE_S,
    SITE,
    USER,
    WORK,
    command,
    probe,
    settings,
)
from deploy.topology import ROLES, Resources, Role
from deploy.topology import role as role_named

NAMESPACE: Final = "topspin"
HUB: Final = "hub"  # the service that all connect to: the router's, or with TLS the learner's
INDEX: Final = "$(POD_INDEX)"  # Kubernetes puts the pod's number here
_PART: Final = "app.kubernetes.io/part-of"
_ROLE: Final = "app.kubernetes.io/component"
_NUMBER: Final = "apps.kubernetes.io/pod-index"
_START_S: Final = 300  # a pod on a kind of CPU that the image was not built on compiles its kernels first
_LEARNER_DISK: Final = "20Gi"
_EVALUATOR_DISK: Final = "1Gi"
_CERTIFICATES: Final = {"name": "tls", "mountPath": CERTIFICATES, "readOnly": True}
ACTOR: Final = role_named("actor")


def labels(role: str) -> dict[str, str]:
    """Return the labels of a role's pods."""
    return {_PART: "topspin", _ROLE: role, "topspin/run": SITE.run}


def base() -> dict[str, list[dict[str, Any]] | dict[str, Any] | str]:
    """Return the files of the base by name: one object, several, or text."""
    return {
        "namespace.yaml": _namespace(),
        "router.yaml": [_router(), _service(HUB, "router", LINK_PORT)],
        **{f"{role.name}.yaml": _workload(role) for role in ROLES},
        "network.yaml": _policies(),
        "disruptions.yaml": [_keep_one("router"), _keep_one("learner")],
        "autoscaler.yaml": _autoscaler(),
        "config.toml": settings(f"tcp/{HUB}:{LINK_PORT}"),
        "kustomization.yaml": {
            "apiVersion": "kustomize.config.k8s.io/v1beta1",
            "kind": "Kustomization",
            "namespace": NAMESPACE,
            "resources": [
                *("namespace.yaml", "router.yaml"),
                *(f"{role.name}.yaml" for role in ROLES),
                *("network.yaml", "disruptions.yaml", "autoscaler.yaml"),
            ],
            "configMapGenerator": [{"name": "settings", "files": ["config.toml"]}],
            "images": [{"name": "topspin", "newTag": IMAGE.partition(":")[2]}],
        },
    }


def tls() -> dict[str, list[dict[str, Any]] | dict[str, Any] | str]:
    """Return the files of the overlay with TLS: the learner is the hub, since the hub applies the roles' rules."""
    mounts = {role.name: _certificates_patch(role) for role in ROLES if role.name != "actor"}
    return {
        "config.toml": settings(f"tls/{HUB}:{LINK_PORT}", tls=True),
        **{f"{name}.yaml": patch for name, patch in mounts.items()},
        "hub.yaml": _service(HUB, "learner", LINK_PORT),
        "actor.yaml": _numbered_actors(),
        "no-actors.yaml": {"$patch": "delete", **_head("apps/v1", "Deployment", "actor")},
        "autoscaler.yaml": _head("autoscaling/v2", "HorizontalPodAutoscaler", "actor")
        | {"spec": {"scaleTargetRef": _scaled("StatefulSet")}},
        "no-router.yaml": {"$patch": "delete", **_head("apps/v1", "Deployment", "router")},
        "no-router-budget.yaml": {"$patch": "delete", **_head("policy/v1", "PodDisruptionBudget", "router")},
        "kustomization.yaml": {
            "apiVersion": "kustomize.config.k8s.io/v1beta1",
            "kind": "Kustomization",
            "namespace": NAMESPACE,
            "resources": ["../base", "actor.yaml"],
            "patches": [
                {"path": f"{name}.yaml"}
                for name in ("hub", "no-router", "no-router-budget", "no-actors", "autoscaler", *mounts)
            ],
            "configMapGenerator": [{"name": "settings", "behavior": "replace", "files": ["config.toml"]}],
        },
    }


# ---- parts


def _head(version: str, kind: str, name: str, **more: Any) -> dict[str, Any]:
    return {"apiVersion": version, "kind": kind, "metadata": {"name": name, "namespace": NAMESPACE, **more}}


def _namespace() -> dict[str, Any]:
    return {
        "apiVersion": "v1",
        "kind": "Namespace",
        "metadata": {"name": NAMESPACE, "labels": {"pod-security.kubernetes.io/enforce": "restricted"}},
    }


def _service(name: str, role: str, port: int) -> dict[str, Any]:
    return _head("v1", "Service", name) | {
        "spec": {
            "selector": labels(role),
            "ports": [{"name": "link", "port": port, "targetPort": "link"}],
        }
    }


def _headless(role: Role) -> dict[str, Any]:
    return _head("v1", "Service", role.name, labels=labels(role.name)) | {
        "spec": {
            "clusterIP": "None",
            "selector": labels(role.name),
            "ports": [{"name": "metrics", "port": FIRST_PORT}],
        }
    }


def _container(arguments: list[str], needs: Resources) -> dict[str, Any]:
    return {
        "name": "topspin",
        "image": IMAGE.partition(":")[0],
        "args": arguments,
        "ports": [{"name": "metrics", "containerPort": FIRST_PORT}],
        "resources": {
            "requests": {"cpu": _cores(needs.cores), "memory": f"{needs.memory_mib}Mi"},
            "limits": {"cpu": _cores(needs.cores_limit), "memory": f"{needs.memory_limit_mib}Mi"},
        },
        "startupProbe": probe("/healthz", 5, _START_S // 5),
        "livenessProbe": probe("/healthz", 20, 6),  # with its own 60 s: a kernel that compiles is no hang
        "readinessProbe": probe("/readyz", 5, 2),
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "volumeMounts": [{"name": "tmp", "mountPath": "/tmp"}, {"name": "cache", "mountPath": CACHE}],
    }


def _cores(cores: float) -> str:
    return f"{round(cores * 1000)}m"


def _pod(role: str, container: dict[str, Any], grace_s: int, volumes: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "metadata": {
            "labels": labels(role),
            "annotations": {"prometheus.io/scrape": "true", "prometheus.io/port": str(FIRST_PORT)},
        },
        "spec": {
            "automountServiceAccountToken": False,
            "enableServiceLinks": False,
            "terminationGracePeriodSeconds": grace_s,
            "securityContext": {
                "runAsNonRoot": True,
                "runAsUser": USER,
                "runAsGroup": USER,
                "fsGroup": USER,
                "seccompProfile": {"type": "RuntimeDefault"},
            },
            "containers": [container],
            "volumes": [{"name": "tmp", "emptyDir": {}}, {"name": "cache", "emptyDir": {}}, *volumes],
        },
    }


def _router() -> dict[str, Any]:
    container = _container(list(ROUTER), Resources(0.25, 1.0, 128, 512))
    container["ports"].append({"name": "link", "containerPort": LINK_PORT})
    return _head("apps/v1", "Deployment", "router", labels=labels("router")) | {
        "spec": {
            "replicas": 1,
            "strategy": {"type": "Recreate"},  # two that don't know each other would split the run
            "selector": {"matchLabels": labels("router")},
            "template": _pod("router", container, ROUTER_GRACE_S, []),
        }
    }


def _workload(role: Role) -> list[dict[str, Any]]:
    if role.name == "actor":
        return [_actors()]
    spec = {"replicas": role.count(SITE), **_numbered(role)}
    return [
        _head("apps/v1", "StatefulSet", role.name, labels=labels(role.name)) | {"spec": spec},
        _headless(role),
    ]


def _role_pod(role: Role, index: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the pod of a role, and its container."""
    container = _container(command(role, index), role.resources)
    container["volumeMounts"].append({"name": "settings", "mountPath": "/etc/topspin", "readOnly": True})
    volumes = [{"name": "settings", "configMap": {"name": "settings"}}]
    return _pod(role.name, container, role.grace_s, volumes), container


def _actors() -> dict[str, Any]:
    """Return the actors; the autoscaler sets how many there are."""
    pod, _ = _role_pod(ACTOR, index="")
    return _head("apps/v1", "Deployment", "actor", labels=labels("actor")) | {
        "spec": {"selector": {"matchLabels": labels("actor")}, "template": pod}
    }


def _numbered(role: Role) -> dict[str, Any]:
    """Return the specification of a StatefulSet, whose pods have numbers."""
    pod, container = _role_pod(role, INDEX)
    container["env"] = [
        {"name": "POD_INDEX", "valueFrom": {"fieldRef": {"fieldPath": f"metadata.labels['{_NUMBER}']"}}}
    ]
    if role.name == "learner":
        container["ports"].append({"name": "link", "containerPort": LINK_PORT})
    spec: dict[str, Any] = {
        "serviceName": role.name,
        "podManagementPolicy": "Parallel",
        "selector": {"matchLabels": labels(role.name)},
        "template": pod,
    }
    if role.keeps_files:
        disk = _LEARNER_DISK if role.name == "learner" else _EVALUATOR_DISK
        container["volumeMounts"].append({"name": "work", "mountPath": WORK})
        spec["volumeClaimTemplates"] = [
            {
                "metadata": {"name": "work"},
                "spec": {"accessModes": ["ReadWriteOnce"], "resources": {"requests": {"storage": disk}}},
            }
        ]
    return spec


def _numbered_actors() -> list[dict[str, Any]]:
    """Return the actors of a run with TLS: the number of a pod names its certificate."""
    spec = _numbered(ACTOR)
    (container,) = spec["template"]["spec"]["containers"]
    container["volumeMounts"].append(_CERTIFICATES)
    spec["template"]["spec"]["volumes"].append(_secret(ACTOR))
    return [
        _head("apps/v1", "StatefulSet", "actor", labels=labels("actor")) | {"spec": spec},
        _headless(ACTOR),
    ]


def _certificates_patch(role: Role) -> dict[str, Any]:
    """Return the patch that mounts a role's certificates; with them the learner listens itself."""
    container: dict[str, Any] = {
        "name": "topspin",
        "volumeMounts": [_CERTIFICATES],
    }
    if role.name == "learner":
        arguments = command(role, INDEX, is_hub=True)
        container["args"] = [*arguments, "--endpoint", f"tls/0.0.0.0:{LINK_PORT}"]
    pod = {"spec": {"containers": [container], "volumes": [_secret(role)]}}
    return _head("apps/v1", "StatefulSet", role.name) | {"spec": {"template": pod}}


def _secret(role: Role) -> dict[str, Any]:
    return {"name": "tls", "secret": {"secretName": f"tls-{role.name}", "defaultMode": 0o440}}


def _keep_one(role: str) -> dict[str, Any]:
    return _head("policy/v1", "PodDisruptionBudget", role) | {
        "spec": {"minAvailable": 1, "selector": {"matchLabels": labels(role)}}
    }


def _scaled(kind: str) -> dict[str, str]:
    return {"apiVersion": "apps/v1", "kind": kind, "name": "actor"}


def _autoscaler() -> dict[str, Any]:
    """Return the rule that adds actors while the learner waits for data, and takes them away again."""
    return _head("autoscaling/v2", "HorizontalPodAutoscaler", "actor") | {
        "spec": {
            "scaleTargetRef": _scaled("Deployment"),
            "minReplicas": SITE.fewest_actors,
            "maxReplicas": SITE.actors,  # actors beyond the setting would get no environments of their own
            "metrics": [
                {
                    "type": "External",
                    "external": {
                        "metric": {"name": WAIT_SHARE, "selector": {"matchLabels": {"run": SITE.run}}},
                        "target": {"type": "Value", "value": f"{round(HUNGER * 1000)}m"},
                    },
                }
            ],
            "behavior": {
                "scaleUp": {"stabilizationWindowSeconds": 120},
                "scaleDown": {"stabilizationWindowSeconds": 600},
            },
        }
    }


def _policies() -> list[dict[str, Any]]:
    """Return who may connect: nobody, but the pods of the run with its hub, and any namespace's Prometheus."""
    all_pods = {"matchLabels": {_PART: "topspin"}}
    link = [{"protocol": "TCP", "port": LINK_PORT}]
    names = [{"protocol": protocol, "port": 53} for protocol in ("UDP", "TCP")]
    monitoring = {
        "namespaceSelector": {},
        "podSelector": {"matchLabels": {"app.kubernetes.io/name": "prometheus"}},
    }
    hubs = {"matchExpressions": [{"key": _ROLE, "operator": "In", "values": ["router", "learner"]}]}
    return [
        _policy("nothing-else", {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}),
        _policy(
            "link",
            {
                "podSelector": hubs,
                "policyTypes": ["Ingress"],
                "ingress": [{"from": [{"podSelector": all_pods}], "ports": link}],
            },
        ),
        _policy(
            "metrics",
            {
                "podSelector": all_pods,
                "policyTypes": ["Ingress"],
                "ingress": [{"from": [monitoring], "ports": [{"protocol": "TCP", "port": FIRST_PORT}]}],
            },
        ),
        _policy(
            "out",
            {
                "podSelector": all_pods,
                "policyTypes": ["Egress"],
                "egress": [{"to": [{"podSelector": hubs}], "ports": link}, {"ports": names}],
            },
        ),
    ]


def _policy(name: str, spec: dict[str, Any]) -> dict[str, Any]:
    return _head("networking.k8s.io/v1", "NetworkPolicy", name) | {"spec": spec}
