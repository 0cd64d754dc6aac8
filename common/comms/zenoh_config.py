"""Where the hub is, and the Zenoh settings that make the transport keep its promises.

Every value is there because its default lost or froze something in measurements:

* shared memory off: with it on, a receiver that was paused for 0.12 s read other messages' bytes, unnoticed;
* multicast, gossip and the admin space off: only the endpoints that somebody wrote down;
* ``wait_before_close`` finite (-1 panics) and long: a put that gives up closes the link without an error;
* a short lease, so that a hung process is noticed; a receive buffer that doubles the throughput at 1 MB.
"""

from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class ZenohConfig(BaseModel):
    """Where the hub is and how to get there."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["hub", "client"] = Field("client", description="listen at the endpoint, or connect to it")
    endpoint: str = Field(
        "tcp/127.0.0.1:7447",
        pattern=r"^(tcp|tls|unixsock-stream)/.+",
        description="where the hub listens",
    )
    peers: tuple[str, ...] = Field((), description="endpoints of other routers that a hub connects to")
    connect_timeout_s: float = Field(
        60.0, gt=0, description="how long a client waits for the hub", json_schema_extra={"unit": "s"}
    )
    lease_s: float = Field(
        3.0,
        ge=0.5,
        le=60,
        description="silence after which others count us as gone",
        json_schema_extra={"unit": "s"},
    )
    max_message_mib: int = Field(
        64, ge=1, le=1024, description="largest message", json_schema_extra={"unit": "MiB"}
    )
    tls_ca: str = Field("", description="file with the authority's certificate; given = mutual TLS")
    tls_certificate: str = Field("", description="file with our certificate")
    tls_key: str = Field("", description="file with our private key")

    @model_validator(mode="after")
    def _tls_is_whole(self) -> Self:
        files = (self.tls_ca, self.tls_certificate, self.tls_key)
        if self.endpoint.startswith("tls/") != any(files) or any(files) != all(files):
            raise ValueError(
                f"endpoint {self.endpoint} with tls_ca, tls_certificate, tls_key = {files}; "
                "allowed: all three with tls/..., none without"
            )
        return self


def session_settings(config: ZenohConfig, attempt_s: float) -> dict[str, Any]:
    """Return Zenoh's settings by path; ``attempt_s`` bounds one attempt to connect."""
    settings: dict[str, Any] = {
        "mode": "router" if config.mode == "hub" else "client",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 10,  # ms; a hub would sit out 500 for peers that it never looks for
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
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 15_000_000,  # us
        "transport/link/rx/max_message_size": config.max_message_mib * 1024 * 1024,
        "queries_default_timeout": 10_000,
    }
    if config.tls_ca:
        settings["transport/link/protocols"] = ["tls"]
        settings["transport/link/tls"] = {
            "root_ca_certificate": config.tls_ca,
            "enable_mtls": True,
            "listen_certificate": config.tls_certificate,
            "listen_private_key": config.tls_key,
            "connect_certificate": config.tls_certificate,
            "connect_private_key": config.tls_key,
        }
    return settings
