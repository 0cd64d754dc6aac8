"""Whether a browser's connection comes from our own page: any site that a person visits can try the loopback port."""

import ipaddress
from urllib.parse import urlsplit


def is_own_page(origin: str | None, host: str, is_local: bool) -> bool:
    """Return whether a connection may stay.

    Browsers say in ``Origin`` which site asks, and scripts of a site can't change it. Other programs send none.

    Args:
        origin: The header ``Origin``.
        host: The header ``Host``: the address that was asked for.
        is_local: Whether the server is reached from this machine alone. Then a name other than ``localhost`` is a
            domain that points to 127.0.0.1, so that somebody's page there looks like ours (DNS rebinding).
    """
    if origin is None:
        return True
    page, asked = urlsplit(origin), urlsplit(f"//{host}")
    return page.netloc == asked.netloc and (not is_local or _is_nobodys_domain(asked.hostname or ""))


def is_loopback(address: str) -> bool:
    """Return whether an address to listen at is reached from this machine alone."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def _is_nobodys_domain(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name == "localhost"
    return True
