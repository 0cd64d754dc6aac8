"""Hosts with addresses and cables of their own on one machine: Linux' network namespaces."""

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from common.errors import ReportedError


@dataclass(frozen=True, slots=True)
class Host:
    """A host on the local network of one switch.

    Args:
        namespace: Its network namespace.
        address: Its IPv4 address.
        cable: The switch's end of its cable.
        switch: The namespace of the switch.
    """

    namespace: str
    address: str
    cable: str
    switch: str

    @property
    def inside(self) -> tuple[str, ...]:
        """What stands before a command that runs on this host."""
        return ("ip", "netns", "exec", self.namespace)

    def set_cable(self, is_in: bool) -> None:
        """Take the cable out of the switch, or put it in."""
        ip("-n", self.switch, "link", "set", self.cable, "up" if is_in else "down")


@contextmanager
def local_network(names: Sequence[str]) -> Iterator[list[Host]]:
    """Yield hosts on one switch, which disappear at the end.

    Raises:
        ReportedError: This process may not make network namespaces.
    """
    number = os.getpid()
    switch = f"switch{number}"
    hosts = [
        Host(f"{name}{number}", f"10.{100 + number % 100}.7.{at}", f"cable{at}", switch)
        for at, name in enumerate(names, start=1)
    ]
    made: list[str] = []
    try:
        for namespace in (switch, *(host.namespace for host in hosts)):
            ip("netns", "add", namespace)
            made.append(namespace)
        ip("-n", switch, "link", "add", "bridge", "type", "bridge")
        ip("-n", switch, "link", "set", "bridge", "up")
        for host in hosts:
            ip(
                "-n",
                switch,
                "link",
                "add",
                host.cable,
                "type",
                "veth",
                "peer",
                "name",
                "eth0",
                "netns",
                host.namespace,
            )
            ip("-n", switch, "link", "set", host.cable, "master", "bridge", "up")
            ip("-n", host.namespace, "addr", "add", f"{host.address}/24", "dev", "eth0")
            for device in ("eth0", "lo"):
                ip("-n", host.namespace, "link", "set", device, "up")
        yield hosts
    finally:
        for namespace in made:
            with suppress(ReportedError):
                ip("netns", "del", namespace)


def ip(*arguments: str) -> None:
    """Run the command `ip`.

    Raises:
        ReportedError: It failed.
    """
    system("ip", *arguments)


def system(*command: str) -> None:
    """Run a command of the system.

    Raises:
        ReportedError: It failed, or there is none.
    """
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    except OSError as error:
        raise ReportedError(f"{command[0]}: {error.strerror}") from None
    if done.returncode:
        raise ReportedError(f"{' '.join(command[:3])}: {done.stderr.strip()}")
