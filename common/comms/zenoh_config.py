"""The hub's endpoint, and the Zenoh settings that the transport's guarantees need.

In measurements the default of each of these settings lost messages or blocked a process:

* Shared memory is off. With it, a receiver that was paused for 0.12 s read the bytes of other messages, without an
  error.
* Multicast, gossip and the admin space are off: Zenoh uses only the configured endpoints.
* ``wait_before_close`` is finite (-1 panics) and long: a put that times out closes the link without an error.
* The hub's answers drop instead of blocking (`qos/network`: an answer takes over how its request was sent). A client
  that asked for 100 policies and then hung stopped the hub for 15 s, and other clients for good. Now it costs nobody
  more than 50 ms. An answer that is dropped is asked for again.
* A hub takes 8,192 links. Zenoh's 1,000 are too few for a run of 1,000 actors: the last services found no hub.
* The lease is short, so that a hung process is detected. The receive buffer doubles the throughput at 1 MB.
* With TLS a link ends when a certificate of it expires, and the hub applies the access rules (`common.comms.roles`).
"""

from dataclasses import dataclass
from typing import Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.comms.certificates import Files

MOST_LINKS: Final = 8192  # of one hub
EVERY_ADDRESS: Final = ("0.0.0.0", "[::]", "[::0]")  # hosts of an endpoint that listens on all of a machine's


def endpoint_for_others(endpoint: str, host: str) -> str:
    """Return the endpoint to give to a client, where ``host`` is the name of the hub's machine.

    A hub may listen on every address of its machine. No client can connect to that.
    """
    kind, _, address = endpoint.partition("/")
    for every in EVERY_ADDRESS:
        if address.startswith(f"{every}:"):
            return f"{kind}/{host}{address.removeprefix(every)}"
    return endpoint


class LinkConfig(BaseModel):
    """Address of the hub and the keys for it: the same for all services of a run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    endpoint: str = Field(
        "tcp/127.0.0.1:7447",
        pattern=r"^(tcp|tls|unixsock-stream)/.+",
        description="endpoint of the hub",
    )
    peers: tuple[str, ...] = Field((), description="endpoints of other routers that a hub connects to")
    connect_timeout_s: float = Field(
        60.0,
        gt=0,
        description="longest time that a client waits for the hub",
        json_schema_extra={"unit": "s"},
    )
    lease_s: float = Field(
        3.0,
        ge=0.5,
        le=60,
        description="silence after which the others consider this process gone",
        json_schema_extra={"unit": "s"},
    )
    max_message_mib: int = Field(
        64, ge=1, le=64, description="largest message", json_schema_extra={"unit": "MiB"}
    )
    tls: str = Field(
        "",
        description="folder of certificates (topspin certs): links are encrypted, and each service may only say what "
        "its role says; empty: open",
    )

    @model_validator(mode="after")
    def _tls_is_whole(self) -> Self:
        if self.endpoint and self.endpoint.startswith("tls/") != bool(self.tls):
            raise ValueError(
                f"endpoint {self.endpoint} with {f'--tls {self.tls}' if self.tls else 'no folder of certificates'}; "
                "allowed: an endpoint tls/... with --tls DIR, any other without"
            )
        if self.tls and self.peers:
            raise ValueError(
                f"peers {','.join(self.peers)} with --tls {self.tls}; allowed: one hub, since its rules would drop "
                "what another router passes on"
            )
        return self


class ZenohConfig(LinkConfig):
    """One end of a link: the hub, or a client of it."""

    mode: Literal["hub", "client"] = Field(
        "client", exclude=True, description="listen at the endpoint, or connect to it"
    )


@dataclass(frozen=True, slots=True)
class Security:
    """What a session with TLS needs besides its configuration."""

    files: Files
    admitted: tuple[str, ...] = ()  # at a hub: names of the certificates that it knows
    access_control: dict[str, Any] | None = None  # at a hub: what their owners may do


def session_settings(
    config: ZenohConfig, attempt_s: float, security: Security | None = None
) -> dict[str, Any]:
    """Return Zenoh's settings by path. One attempt to connect takes at most ``attempt_s`` [s]."""
    settings: dict[str, Any] = {
        "mode": "router" if config.mode == "hub" else "client",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 10,  # ms; by default a hub waits 500 ms for peers, which it does not need
        "adminspace/enabled": False,
        "listen/endpoints": [config.endpoint] if config.mode == "hub" else [],
        "connect/endpoints": list(config.peers) if config.mode == "hub" else [config.endpoint],
        "connect/timeout_ms": int(attempt_s * 1000),
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 1.5},
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": int(config.lease_s * 1000),
        "transport/link/rx/buffer_size": 4 * 1024 * 1024,  # twice the throughput at 1 MB
        "transport/link/tx/queue/size/data": 16,
        "transport/link/tx/queue/size/data_high": 16,  # a policy of 1 MB fits: it is dropped where it doesn't
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 15_000_000,  # us
        "transport/link/rx/max_message_size": config.max_message_mib * 1024 * 1024,
        "queries_default_timeout": 10_000,
    }
    if config.mode == "hub":
        settings["transport/unicast/max_sessions"] = MOST_LINKS
        settings["qos/network"] = [
            {
                "messages": ["query"],
                "flows": ["ingress"],
                "key_exprs": ["**"],
                "overwrite": {"congestion_control": "drop"},
            }
        ]
    if security is not None:
        certificate, key = str(security.files.certificate), str(security.files.key)
        settings["transport/link/protocols"] = ["tls"]
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(security.files.ca),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        }
        if security.access_control is not None:
            settings["access_control"] = security.access_control
    return settings
