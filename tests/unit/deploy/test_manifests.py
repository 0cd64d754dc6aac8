"""The files that run Topspin elsewhere: they are what the tables say, their flags exist, and their schemas hold."""

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from common.errors import ConfigError
from common.service.config import load
from deploy.manifests import compose, hosts, kubernetes
from deploy.manifests.files import FOLDER, files
from deploy.manifests.site import ROUTER, SITE
from deploy.router import RouterConfig
from deploy.topology import ROLES
from services.actor.config import ActorConfig
from services.evaluator.config import EvaluatorConfig
from services.generator.config import GeneratorConfig
from services.learner.config import LearnerConfig

MODELS = {
    "services.learner": LearnerConfig,
    "services.actor": ActorConfig,
    "services.generator": GeneratorConfig,
    "services.evaluator": EvaluatorConfig,
    "deploy.router": RouterConfig,
}
BY_HAND = {"cluster/Dockerfile", "cluster/entrypoint.sh"}
KUBERNETES = "1.32"
NAMES = [f"{role.name}-{i}" for role in ROLES for i in range(role.count(SITE))]


def needs(tool):
    return pytest.mark.skipif(shutil.which(tool) is None, reason=f"{tool} is not installed")


def checked(*command):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def documents(folder):
    found = []
    for name, text in files().items():
        if name.startswith(f"cluster/kubernetes/{folder}/") and name.endswith(".yaml"):
            found += [d for d in yaml.safe_load_all(text) if d["kind"] != "Kustomization"]
    return found


def read_by_its_program(words, tmp_path, text):
    """Return the settings that a program reads from a command of a manifest."""
    module, *flags = words
    file = tmp_path / "config.toml"
    file.write_text(text)
    flags = [str(file) if flag.endswith((".toml", "$settings", "$1")) else flag for flag in flags]
    return load(MODELS[module], flags, prog="p", section=module.rpartition(".")[2], environ={})


def test_the_files_in_the_repository_are_what_the_tables_give():
    expected = files()

    for name, text in expected.items():
        assert (FOLDER / name).read_text() == text, f"deploy/{name}: run python -m deploy.manifests"
    for folder in ("monitoring", "cluster"):
        found = {str(p.relative_to(FOLDER)) for p in (FOLDER / folder).rglob("*") if p.is_file()}
        assert found - expected.keys() - BY_HAND == set()


def test_every_command_of_a_container_is_read_by_its_program(tmp_path):
    text = files()["cluster/config.toml"]
    for name, service in compose.compose()["services"].items():
        if name in ("prometheus", "grafana"):
            continue
        config = read_by_its_program(service["command"], tmp_path, text)

        assert config.metrics_host == "0.0.0.0"
        assert config.run == SITE.run
        if name != "router":
            assert f"{service['command'][0].rpartition('.')[2]}-{config.id}" == name
            assert config.endpoint == "tcp/router:7447"
            assert not hasattr(config, "actors") or config.actors == SITE.actors


def test_every_command_of_a_pod_is_read_by_its_program(tmp_path):
    text = files()["cluster/kubernetes/base/config.toml"]
    for workload in documents("base"):
        if workload["kind"] in ("StatefulSet", "Deployment"):
            (container,) = workload["spec"]["template"]["spec"]["containers"]
            words = [word.replace("$(POD_INDEX)", "0") for word in container["args"]]
            config = read_by_its_program(words, tmp_path, text)

            assert config.run == SITE.run
            assert config.mode == ("hub" if words[0] == "deploy.router" else "client")


def test_every_command_of_a_unit_and_of_the_job_is_read_by_its_program(tmp_path):
    text = 'run = "r"\nendpoint = "tcp/host:7447"\n'
    commands = [re.search(r"ExecStart=((?:.*\\\n)*.*)", unit) for unit in hosts.units().values()]
    lines = [c.group(1).replace("\\\n", " ").replace("%i", "0") for c in commands if c]
    lines += [
        line.replace("$SLURM_PROCID", "0").split("' ")[0].split(" >>")[0].replace("bash -c 'exec", "")
        for line in hosts.slurm().splitlines()
        if "-m services." in line
    ]
    read = [read_by_its_program(shlex.split(line)[2:], tmp_path, text) for line in lines]

    assert len(lines) == 2 * len(ROLES)
    assert {type(config) for config in read} == set(MODELS.values()) - {RouterConfig}
    assert {c.endpoint for c in read if isinstance(c, LearnerConfig)} == {"tcp/0.0.0.0:7447"}


def test_no_variable_of_a_manifest_looks_like_a_setting():
    """A service refuses a variable TOPSPIN_... that is none of its settings."""
    by_hand = [(FOLDER / name).read_text() for name in BY_HAND]

    assert [word for text in (*files().values(), *by_hand) for word in re.findall(r"TOPSPIN_\w+", text)] == []


def test_containers_have_no_rights_a_read_only_file_system_limits_and_a_health_check():
    for name, service in compose.compose()["services"].items():
        if name not in ("prometheus", "grafana"):
            assert service["read_only"], name
            assert service["user"].split(":")[0] not in ("", "0", "root")
            assert service["cap_drop"] == ["ALL"]
            assert service["mem_limit"]
            assert service["healthcheck"]["test"][-1].endswith("/healthz")
    for workload in documents("base"):
        if workload["kind"] in ("StatefulSet", "Deployment"):
            pod = workload["spec"]["template"]["spec"]
            (container,) = pod["containers"]
            assert pod["securityContext"]["runAsNonRoot"]
            assert container["securityContext"]["readOnlyRootFilesystem"]
            assert container["resources"]["limits"].keys() == {"cpu", "memory"}
            probes = {k: v["httpGet"]["path"] for k, v in container.items() if k.endswith("Probe")}
            assert probes == {
                "startupProbe": "/healthz",
                "livenessProbe": "/healthz",
                "readinessProbe": "/readyz",
            }
    dockerfile = (FOLDER / "cluster/Dockerfile").read_text()
    assert re.search(r"^USER 10001:10001$", dockerfile, re.M)


def test_prometheus_finds_every_container_by_its_name():
    services = compose.compose()["services"]
    hosts_ = {group["targets"][0].partition(":")[0] for group in compose.targets()}

    assert hosts_ == services.keys() - {"prometheus", "grafana"} == {"router", *NAMES}


def test_kubernetes_schemas_hold():
    for document in documents("base"):
        kubernetes_validate.validate(document, KUBERNETES, strict=True)


def test_a_pod_is_scaled_by_the_hunger_that_a_rule_records():
    (scaler,) = [d for d in documents("base") if d["kind"] == "HorizontalPodAutoscaler"]
    rules = yaml.safe_load(files()["monitoring/alerts.yml"])["groups"][0]["rules"]

    metric = scaler["spec"]["metrics"][0]["external"]["metric"]["name"]
    assert metric in {rule.get("record") for rule in rules}
    assert scaler["spec"]["maxReplicas"] == SITE.actors


def test_with_tls_the_learner_listens_and_the_others_look_for_it_by_the_name_of_its_service(tmp_path):
    text = files()["cluster/kubernetes/tls/config.toml"]
    (patch,) = [
        d for d in documents("tls") if (d["kind"], d["metadata"]["name"]) == ("StatefulSet", "learner")
    ]
    words = patch["spec"]["template"]["spec"]["containers"][0]["args"]

    learner = read_by_its_program([word.replace("$(POD_INDEX)", "0") for word in words], tmp_path, text)
    actor = read_by_its_program(ROLES[-1].arguments("3", "config.toml", "9100"), tmp_path, text)

    assert (learner.mode, learner.endpoint, learner.tls) == ("hub", "tls/0.0.0.0:7447", "/etc/topspin-tls")
    assert (actor.mode, actor.endpoint, actor.tls, actor.id) == ("client", "tls/hub:7447", learner.tls, "3")


@needs("kubectl")
@pytest.mark.parametrize("folder", ["base", "tls"])
def test_kustomize_builds_what_the_schemas_allow_with_one_hub(folder):
    text = checked("kubectl", "kustomize", FOLDER / "cluster/kubernetes" / folder)
    found = list(yaml.safe_load_all(text))
    for document in found:
        kubernetes_validate.validate(document, KUBERNETES, strict=True)

    by_name = {(d["kind"], d["metadata"]["name"]): d for d in found}
    hub = by_name["Service", kubernetes.HUB]["spec"]["selector"]["app.kubernetes.io/component"]
    assert hub == ("router" if folder == "base" else "learner")
    assert (("Deployment", "router") in by_name) == (folder == "base")
    (settings,) = [d["data"]["config.toml"] for d in found if d["kind"] == "ConfigMap"]
    assert ("tls" in tomllib.loads(settings)) == (folder == "tls")
    secrets = re.findall(r"secretName: (\S+)", text)
    assert sorted(secrets) == ([] if folder == "base" else sorted(f"tls-{role.name}" for role in ROLES))


@needs("systemd-analyze")
def test_systemd_accepts_the_units(tmp_path):
    paths = []
    for name, text in hosts.units().items():
        path = tmp_path / name.replace("@.", "@0.")
        path.write_text(text.replace(hosts.INSTALL, "/bin/true"))
        paths.append(path)

    checked("systemd-analyze", "verify", *paths)


@needs("shellcheck")
def test_shell_scripts_are_clean():
    checked("shellcheck", *sorted((FOLDER / "cluster").glob("*.sh")))


def test_compose_has_the_schema_of_the_compose_specification():
    checked(
        *(sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"),
        FOLDER / "cluster/compose.yaml",
    )


def test_the_dockerfile_names_only_what_is_there():
    root = FOLDER.parent
    copied = re.findall(
        r"^COPY (?!--from)(?:--\S+ )?(.+) \S+$", (FOLDER / "cluster/Dockerfile").read_text(), re.M
    )

    sources = [name for words in copied for name in words.split()]
    assert sources
    assert [name for name in sources if not (root / name).exists()] == []
    allowed = {line[1:] for line in (root / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert {name.split("/")[0] for name in sources} <= allowed


def test_a_router_with_certificates_is_refused_since_the_hub_applies_the_rules(tmp_path):
    with pytest.raises(ConfigError, match="tls certs; allowed: none: with TLS the learner is the hub"):
        read_by_its_program(("deploy.router", "--endpoint", "tls/0.0.0.0:1", "--tls", "certs"), tmp_path, "")


def test_the_router_listens_where_its_manifest_says(tmp_path):
    config = read_by_its_program(ROUTER, tmp_path, "")

    assert (config.endpoint, config.mode, config.metrics_port) == ("tcp/0.0.0.0:7447", "hub", 9100)
    assert json.loads((FOLDER / "cluster/targets.json").read_text())[0]["labels"]["role"] == "router"
    assert Path(FOLDER / "cluster/entrypoint.sh").stat().st_mode & 0o111
