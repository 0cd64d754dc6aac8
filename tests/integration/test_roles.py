"""Who may speak: real certificates and real links. Everything that a role may not is tried, and dropped by the hub."""

import shutil

import pytest
import zenoh

from benchmarks.attacker import open_session
from benchmarks.role_trials import allowed, try_all
from common.comms.certificates import CertificateError, checked, create_authority, files_of, issue, refusal
from common.comms.keys import Keys
from common.comms.roles import Rights, rights_of
from common.comms.transport import TransportError
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from deploy.prepare import free_endpoint
from tests.waiting import wait_until

KEYS = Keys("r")
NAMES = ("learner-0", "actor-0", "generator-0", "evaluator-0", "operator-0")
QUICK = {"connect_timeout_s": 1.0}  # for a link that is refused
ALL = Rights(*[("**",)] * 6)


def made(folder, names=("learner-0", "actor-0"), hosts=("127.0.0.1",), days=1.0):
    folder.mkdir()
    create_authority(folder, 1.0)
    for name in names:
        issue(folder, name, hosts, days)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made(tmp_path_factory.mktemp("tls") / "certs", NAMES)


@pytest.fixture(scope="module")
def secured(folder):
    """A hub that knows `NAMES`; ``actor-9`` and ``actor-5``, made after its start, are strangers."""
    endpoint = free_endpoint("tls")
    hub = open_zenoh(ZenohConfig(mode="hub", endpoint=endpoint, tls=str(folder)), name="learner-0", run="r")
    issue(folder, "actor-9", (), 1.0)
    issue(folder, "actor-5", (), -0.001)
    yield hub, ZenohConfig(endpoint=endpoint, tls=str(folder), connect_timeout_s=5.0)
    hub.close()


@pytest.mark.parametrize("name", [*NAMES, "actor-9"])
def test_all_that_a_role_may_arrives_and_nothing_else(secured, name):
    hub, config = secured
    rights = rights_of(name, KEYS) if name in NAMES else Rights()
    tried, passed = try_all(
        hub,
        lambda: open_session(config, name),
        lambda: open_zenoh(config, name=name),
        *(KEYS, name.partition("-")[2], rights),
    )

    assert {trial for trial in passed if not allowed(rights, trial)} == set()
    assert {trial for trial in tried if allowed(rights, trial)} <= passed
    assert len(tried) > 100


def test_at_an_open_hub_all_of_it_arrives():
    """So the trials would show it."""
    config = ZenohConfig(endpoint=free_endpoint())
    hub = open_zenoh(config.model_copy(update={"mode": "hub"}))
    tried, passed = try_all(hub, lambda: open_session(config), lambda: open_zenoh(config), KEYS, "0", ALL)
    hub.close()

    assert tried <= passed


def test_the_hub_names_a_certificate_that_it_does_not_know(secured, caplog):
    hub, config = secured
    stranger = open_zenoh(config, name="actor-9")
    wait_until(lambda: hub.connected and "'actor-9' is not in the folder" in caplog.text, 5, "its name")
    stranger.close()


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("actor-5", {}),
        ("actor-0", {"connect_certificate": None, "connect_private_key": None, "enable_mtls": False}),
    ],
)
def test_the_hub_opens_no_link_for_an_expired_certificate_or_none(secured, name, changes):
    _, config = secured
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        open_session(config, name, 1.0, **changes)

    assert "certificate expired" in refusal(config.endpoint, files_of(config.tls, "actor-5"))


def test_the_hub_opens_no_link_for_a_certificate_of_another_authority(secured, folder, tmp_path):
    _, config = secured
    other = made(tmp_path / "other")
    forged = tmp_path / "forged"
    forged.mkdir()
    shutil.copy(folder / "ca.pem", forged)
    for suffix in ("pem", "key"):
        shutil.copy(other / f"actor-0.{suffix}", forged)
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        open_session(config.model_copy(update={"tls": str(forged)}), "actor-0", 1.0)

    assert "alert decrypt error" in refusal(config.endpoint, files_of(forged, "actor-0"))
    with pytest.raises(TransportError, match="the hub's certificate is refused: unable to get local issuer"):
        open_zenoh(config.model_copy(update={"tls": str(other)} | QUICK), name="actor-0")


def test_a_client_without_tls_is_told_that_the_hub_wants_it(secured):
    _, config = secured
    open_config = ZenohConfig(endpoint=config.endpoint.replace("tls/", "tcp/"), **QUICK)
    with pytest.raises(TransportError, match=r"it wants TLS; give an endpoint tls/... and --tls DIR"):
        open_zenoh(open_config)


def test_no_certificate_but_a_learners_makes_a_hub(folder):
    config = ZenohConfig(endpoint=free_endpoint("tls"), tls=str(folder), **QUICK)
    impostor = open_zenoh(config.model_copy(update={"mode": "hub"}), name="actor-0", run="r")
    with pytest.raises(
        TransportError, match="the hub's certificate is refused: unsuitable certificate purpose"
    ):
        open_zenoh(config, name="evaluator-0")
    impostor.close()


def test_a_link_ends_when_its_certificate_expires(secured, folder):
    _, config = secured
    issue(folder, "actor-6", (), 2.0 / 86_400.0)
    link = open_zenoh(config, name="actor-6")
    connected = link.connected
    wait_until(lambda: not link.connected, 10, "the end of the link")
    link.close()

    assert connected


def test_a_certificate_that_cannot_be_used_is_refused_before_any_link(tmp_path):
    folder = made(tmp_path / "certs")
    other = made(tmp_path / "other")
    issue(folder, "actor-1", (), -0.001)
    for name, source in (("actor-2.pem", folder / "actor-0.pem"), ("actor-3.pem", other / "actor-0.pem")):
        shutil.copy(source, folder / name)
    for name, of in (("actor-2", "actor-0"), ("actor-3", "actor-0")):
        shutil.copy(folder / f"{of}.key", folder / f"{name}.key")
    shutil.copy(other / "actor-0.pem", other / "learner-0.pem")
    issue(folder, "actor-4", (), 1.0)
    shutil.copy(other / "actor-0.key", folder / "actor-4.key")
    (folder / "actor-0.pem").rename(folder / "kept.pem")
    shutil.copy(other / "actor-0.pem", folder / "actor-0.pem")

    for name, message in (
        ("actor-7", r"there is no .*actor-7.pem; make it with: topspin certs --out .* --add actor-7"),
        ("actor-1", r"actor-1.pem has expired at 20.* UTC; remove it, and make it with"),
        ("actor-2", r"actor-2.pem is the certificate of 'actor-0'; allowed: 'actor-2'"),
        ("actor-0", r"actor-0.pem was not signed by .*ca.pem"),
        ("actor-4", r"actor-4.key is not the key of .*actor-4.pem"),
    ):
        with pytest.raises(CertificateError, match=message):
            checked(folder, name)
