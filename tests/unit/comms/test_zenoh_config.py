import pytest
from pydantic import ValidationError

from common.comms.certificates import files_of
from common.comms.roles import access_control
from common.comms.zenoh_config import Security, ZenohConfig, endpoint_for_others, session_settings

SECURITY = Security(files_of("certs", "learner-0"), ("actor-0",), access_control(["actor-0"], "r"))


def test_only_the_hub_listens_and_only_clients_connect_to_it():
    hub = session_settings(ZenohConfig(mode="hub", peers=("tcp/site:7447",)), attempt_s=2.0)
    client = session_settings(ZenohConfig(), attempt_s=2.0)

    assert (hub["mode"], hub["listen/endpoints"], hub["connect/endpoints"]) == (
        "router",
        ["tcp/127.0.0.1:7447"],
        ["tcp/site:7447"],
    )
    assert (client["mode"], client["listen/endpoints"], client["connect/endpoints"]) == (
        "client",
        [],
        ["tcp/127.0.0.1:7447"],
    )


def test_a_hub_takes_more_links_than_a_run_of_1000_actors_has():
    hub = session_settings(ZenohConfig(mode="hub"), attempt_s=2.0)

    assert hub["transport/unicast/max_sessions"] > 1000 + 100  # actors, and all others


def test_features_that_corrupt_or_expose_data_are_off():
    settings = session_settings(ZenohConfig(), attempt_s=2.0)

    for path in (
        "transport/shared_memory/enabled",
        "scouting/multicast/enabled",
        "scouting/gossip/enabled",
        "adminspace/enabled",
    ):
        assert settings[path] is False


@pytest.mark.parametrize(
    ("endpoint", "wanted"),
    [
        ("tcp/0.0.0.0:7447", "tcp/hall:7447"),
        ("tls/[::]:7447", "tls/hall:7447"),
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447"),
        ("unixsock-stream//tmp/hub", "unixsock-stream//tmp/hub"),
    ],
)
def test_the_endpoint_for_others_is_one_that_they_can_reach(endpoint, wanted):
    assert endpoint_for_others(endpoint, "hall") == wanted


def test_with_tls_links_are_mutual_and_the_hub_applies_the_roles():
    config = ZenohConfig(endpoint="tls/site:7447", tls="certs", mode="hub")
    settings = session_settings(config, attempt_s=2.0, security=SECURITY)

    assert settings["transport/link/protocols"] == ["tls"]
    assert settings["transport/link/tls"]["enable_mtls"] is True
    assert settings["access_control"]["default_permission"] == "deny"


def test_a_hub_that_applies_roles_has_no_peers():
    with pytest.raises(ValidationError, match=r"peers tls/b:1 with --tls certs; allowed: one hub"):
        ZenohConfig(endpoint="tls/a:1", tls="certs", peers=("tls/b:1",))


@pytest.mark.parametrize("bad", [{"endpoint": "tls/site:7447"}, {"tls": "certs"}])
def test_a_tls_endpoint_and_only_that_needs_certificates(bad):
    with pytest.raises(
        ValidationError, match=r"allowed: an endpoint tls/... with --tls DIR, any other without"
    ):
        ZenohConfig(**bad)
