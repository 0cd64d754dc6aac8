"""The live page's server answers its own page, and no other site that a person has open."""

import pytest

from topspin.view.origin import is_loopback, is_own_page

pytest.importorskip("viser", reason="viser is missing: pip install -e '.[view]'")

HOME, NETWORK = True, False  # what the server listens at


@pytest.mark.parametrize(
    ("origin", "host", "is_local", "may_stay"),
    [
        ("http://127.0.0.1:8300", "127.0.0.1:8300", HOME, True),
        ("http://localhost:8300", "localhost:8300", HOME, True),
        ("http://[::1]:8300", "[::1]:8300", HOME, True),
        ("http://localhost:9000", "localhost:9000", HOME, True),  # a tunnel with another port
        (None, "127.0.0.1:8300", HOME, True),  # a program
        ("https://elsewhere.example", "127.0.0.1:8300", HOME, False),
        ("http://127.0.0.1:3000", "127.0.0.1:8300", HOME, False),  # another program's page
        ("null", "127.0.0.1:8300", HOME, False),  # a file, or a page in a sandbox
        ("http://rebound.example:8300", "rebound.example:8300", HOME, False),
        ("http://lab.example:8300", "lab.example:8300", NETWORK, True),
        ("https://elsewhere.example", "lab.example:8300", NETWORK, False),
    ],
)
def test_only_a_page_of_the_same_address_may_stay(origin, host, is_local, may_stay):
    assert is_own_page(origin, host, is_local) == may_stay


@pytest.mark.parametrize(
    ("address", "is_home"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("lab.example", False)],
)
def test_only_loopback_is_reached_from_this_machine_alone(address, is_home):
    assert is_loopback(address) == is_home


@pytest.fixture(scope="module")
def server():
    from topspin.view.command import free_port
    from topspin.view.page import LocalServer

    found = LocalServer("127.0.0.1", free_port("127.0.0.1", 0))
    yield found
    found.stop()


def answer_to(server, origin):
    """Return the first message to a browser's page of this origin."""
    import viser
    from websockets.sync.client import connect

    address = f"ws://127.0.0.1:{server.get_port()}"
    with connect(address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"]) as connection:
        return connection.recv(timeout=20)


def test_a_page_of_another_site_gets_no_message(server, caplog):
    from websockets.exceptions import ConnectionClosedError

    with pytest.raises(ConnectionClosedError, match=r"1008 .* not a page of this server"):
        answer_to(server, "https://elsewhere.example")

    assert (
        "a page of https://elsewhere.example was refused; allowed: the page at http://127.0.0.1"
        in caplog.text
    )


@pytest.mark.parametrize("origin", ["http://127.0.0.1:{}", None])
def test_the_own_page_and_programs_get_the_scene(server, origin):
    assert answer_to(server, origin and origin.format(server.get_port()))
