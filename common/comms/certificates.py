"""Certificates of a run: one folder with the authority's certificate, and a certificate and key for each service.

| file | who needs it |
|---|---|
| `ca.pem` | everyone: the certificate of the authority |
| `ca.key` | only `topspin certs`, which signs with it: keep it away from the hosts of a run |
| `actor-0.pem` | actor 0, and the hub: it admits the names whose certificates are in its folder |
| `actor-0.key` | actor 0 alone |

The common name of a certificate is `<role>-<id>`. It decides what its owner may say (`common.comms.roles`). Only the
certificate of a learner is valid for a hub, at the hosts that it names.
"""

import os
import socket
import ssl
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.errors import ConfigError

CA: Final = "ca"
HUB_ROLE: Final = "learner"
SKEW: Final = timedelta(hours=1)  # clocks of hosts may differ by so much
ANSWER_S: Final = 2.0  # [s] longest wait for the other side's verdict on a certificate


class CertificateError(ConfigError):
    """A certificate that can't be used or made: one line with the file, and what is allowed."""


@dataclass(frozen=True, slots=True)
class Files:
    """What one end of a link needs."""

    ca: Path
    certificate: Path
    key: Path


def files_of(folder: str | Path, name: str) -> Files:
    """Return the files of one name, such as ``actor-0``, in a folder."""
    root = Path(folder)
    return Files(root / f"{CA}.pem", root / f"{name}.pem", root / f"{name}.key")


def missing(folder: str | Path, names: Iterable[str]) -> list[str]:
    """Return those of the names that have no certificate in a folder."""
    return [name for name in names if not files_of(folder, name).certificate.exists()]


def names_in(folder: str | Path) -> tuple[str, ...]:
    """Return the names whose certificates are in a folder."""
    return tuple(sorted(path.stem for path in Path(folder).glob("*.pem") if path.stem != CA))


def valid_until(certificate: Path) -> str:
    """Return when a certificate expires. Its links end then."""
    return f"{_read(certificate).not_valid_after_utc:%Y-%m-%d %H:%M} UTC"


def checked(folder: str | Path, name: str) -> Files:
    """Return the files of one name, which can be used now.

    Raises:
        CertificateError: A file is missing or unreadable, the certificate has expired, is not the authority's, is
            another name's, or does not belong to the key.
    """
    files = files_of(folder, name)
    make = f"make it with: topspin certs --out {folder} --add {name}"
    for path in (files.ca, files.certificate, files.key):
        if not path.is_file():
            raise CertificateError(f"there is no {path}; {make}")
    authority, certificate, now = _read(files.ca), _read(files.certificate), datetime.now(UTC)
    for path, found in ((files.ca, authority), (files.certificate, certificate)):
        if now > found.not_valid_after_utc:
            raise CertificateError(f"{path} has expired at {valid_until(path)}; remove it, and {make}")
        if now < found.not_valid_before_utc:
            raise CertificateError(f"{path} is valid from {found.not_valid_before_utc:%Y-%m-%d %H:%M} UTC on")
    if (common_name := _common_name(certificate)) != name:
        raise CertificateError(
            f"{files.certificate} is the certificate of {common_name!r}; allowed: {name!r}"
        )
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        raise CertificateError(f"{files.certificate} was not signed by {files.ca}; {make}") from None
    try:
        key = serialization.load_pem_private_key(files.key.read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise CertificateError(f"{files.key} can't be read as a key: {error}") from None
    if key.public_key() != certificate.public_key():
        raise CertificateError(f"{files.key} is not the key of {files.certificate}")
    return files


def refusal(endpoint: str, files: Files) -> str:
    """Return why one side of a link refuses the other's certificate, or "" if neither does or nobody listens.

    Zenoh only says that it could not connect. So this opens a link of its own to ``endpoint`` (tls/HOST:PORT).
    """
    host, port = _address(endpoint)
    context = ssl.create_default_context(cafile=str(files.ca))
    context.load_cert_chain(files.certificate, files.key)
    try:
        with (
            socket.create_connection((host, port), ANSWER_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as link,
        ):
            link.recv(
                1
            )  # after the handshake the hub judges this certificate; silence means that it takes it
    except ssl.SSLCertVerificationError as error:
        return f"the hub's certificate is refused: {error.verify_message}"
    except ssl.SSLError as error:
        text = (error.reason or str(error)).lower().replace("_", " ")
        return f"no TLS link to the hub with {files.certificate}: {text}"
    except OSError:
        return ""
    return ""


def speaks_tls(endpoint: str) -> bool:
    """Return whether a hub at ``endpoint`` (tcp/HOST:PORT) wants TLS."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    host, port = _address(endpoint)
    try:
        with (
            socket.create_connection((host, port), ANSWER_S) as plain,
            context.wrap_socket(plain, server_hostname=host),
        ):
            return True
    except OSError:  # also an ssl.SSLError
        return False


def create_authority(folder: Path, days: float) -> None:
    """Make an authority: ``ca.pem`` and ``ca.key``, valid for so many days."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Topspin development CA")])
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    certificate = (
        _builder(name, name, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    _write(folder, CA, certificate, key)


def issue(folder: Path, name: str, hosts: Sequence[str], days: float) -> None:
    """Make the certificate and key of one name, signed by the folder's authority.

    Args:
        folder: Holds ``ca.pem`` and ``ca.key``.
        name: Common name, such as ``actor-0``.
        hosts: Names and addresses that a hub is reached at; only a learner's certificate names them.
        days: Validity.
    """
    authority = _read(folder / f"{CA}.pem")
    try:
        signer = serialization.load_pem_private_key((folder / f"{CA}.key").read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise CertificateError(f"{folder / CA}.key can't be read as a key: {error}") from None
    if not isinstance(signer, ec.EllipticCurvePrivateKey) or signer.public_key() != authority.public_key():
        raise CertificateError(f"{folder / CA}.key is not the key of {folder / CA}.pem")
    is_hub = name.partition("-")[0] == HUB_ROLE
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * is_hub
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        _builder(
            x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]),
            authority.subject,
            key.public_key(),
            days,
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
        )
    )
    if is_hub:
        builder = builder.add_extension(
            x509.SubjectAlternativeName([_host(host) for host in hosts]), critical=False
        )
    _write(folder, name, builder.sign(signer, hashes.SHA256()), key)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: float
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now + timedelta(days=days))
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write(folder: Path, name: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
    """Write a new certificate and its key, which only their owner can read."""
    pem = serialization.Encoding.PEM
    private = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    for suffix, content in ((".key", private), (".pem", certificate.public_bytes(pem))):
        path = folder / f"{name}{suffix}"
        try:
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            raise CertificateError(
                f"{path} exists already, and is not overwritten: remove it first"
            ) from None
        with open(handle, "wb") as file:
            file.write(content)


def _read(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise CertificateError(f"{path} can't be read as a certificate: {error}") from None


def _common_name(certificate: x509.Certificate) -> str:
    return next((str(a.value) for a in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)), "")


def _address(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.partition("/")[2].partition("?")[0].rpartition(":")
    return host.strip("[]"), int(port) if port.isdigit() else 0
