"""`topspin certs`: a development authority, and a certificate for each service of a run."""

import logging
import socket
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field

from common.comms.certificates import CA, CertificateError, create_authority, files_of, issue
from common.comms.keys import Keys
from common.comms.roles import OPERATOR_NAME, name_of, rights_of
from common.service.config import load
from common.service.log import set_up_logging
from common.service.process import DONE
from common.service.settings import LOCAL_ACTORS, MOST_ACTORS

log = logging.getLogger(__name__)

PROG: Final = "topspin certs"
LOCAL: Final = ("localhost", "127.0.0.1", "::1")


class CertsConfig(BaseModel):
    """Make a folder of certificates: an authority, and a certificate and key for each service of a run.

    Give the folder to a run with --tls. A service is who its certificate says, and may say only what its role says.
    The authority is for development: whoever has its key, ca.key, can be any service.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    often: ClassVar = {
        "Where": ("out",),
        "For whom": ("actors", "generators", "add"),
        "Validity": ("hosts", "days"),
    }

    out: str = Field("certs", description="folder to write into; a file in it is never overwritten")
    actors: int = Field(
        LOCAL_ACTORS,
        ge=1,
        le=MOST_ACTORS,
        description="actors to make certificates for: actor-0, actor-1, ...",
    )
    generators: int = Field(1, ge=1, le=100, description="generators: generator-0, generator-1, ...")
    add: tuple[str, ...] = Field(
        (),
        description="certificates to add to a folder, such as actor-8,actor-lab; empty: learner-0, evaluator-0, "
        "operator-0, and one for each actor and generator",
    )
    hosts: tuple[str, ...] = Field(
        (),
        description="names and addresses of the learner's machine, besides this machine's name and loopback",
    )
    days: int = Field(365, ge=1, le=3650, description="validity", json_schema_extra={"unit": "days"})


def names_of(config: CertsConfig) -> tuple[str, ...]:
    """Return the names of the certificates to make, such as ``actor-0``."""
    if config.add:
        return tuple(dict.fromkeys(config.add))
    actors = (name_of("actor", str(i)) for i in range(config.actors))
    generators = (name_of("generator", str(i)) for i in range(config.generators))
    return ("learner-0", "evaluator-0", OPERATOR_NAME, *generators, *actors)


def main(argv: Sequence[str], stop: Event) -> int:
    """Write the files; return the exit status."""
    config = load(CertsConfig, argv, prog=PROG, section="certs")
    set_up_logging("info", "certs")
    write(config)
    return DONE


def write(config: CertsConfig) -> None:
    """Write the files. Nothing is written if one of them exists already, or a name is of no role."""
    folder, names = Path(config.out), names_of(config)
    for name in names:
        rights_of(name, Keys("any"))  # refuses a name that no service can have
    has_authority = files_of(folder, CA).key.exists()
    if config.add and not has_authority:
        raise CertificateError(
            f"there is no {files_of(folder, CA).key} to sign with; make a folder without --add first"
        )
    new = names if config.add else (CA, *names)
    for name in new:
        files = files_of(folder, name)
        for path in (files.certificate, files.key):
            if path.exists():
                raise CertificateError(
                    f"{path} exists already, and nothing is overwritten; choose another --out, or name what is "
                    "missing with --add"
                )
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    if not config.add:
        create_authority(folder, config.days)
    hosts = tuple(dict.fromkeys((*LOCAL, socket.gethostname(), *config.hosts)))
    for name in names:
        issue(folder, name, hosts, config.days)
    log.info(
        "certificates written folder=%s names=%s days=%d hosts=%s",
        folder,
        ",".join(names),
        config.days,
        ",".join(hosts),
    )
