"""Messages that arrive at a closed mailbox, and requests that arrive at a closed server."""

import pytest

from common.comms.transport import Bell, Mailbox, Request, Server


@pytest.mark.parametrize("keep", ["newest", "oldest"])
def test_a_closed_mailbox_returns_its_content_and_accepts_nothing(keep):
    mailbox: Mailbox[int] = Mailbox(Bell(), 4, keep)
    mailbox.put(1)
    mailbox.put(2)

    assert mailbox.close() == [1, 2]

    assert not mailbox.put(3)
    assert mailbox.take() is None
    assert mailbox.dropped == 0


def test_a_request_that_arrives_while_its_server_closes_is_refused():
    """Zenoh's threads may still deliver requests while a queryable is undeclared, and after it."""
    inbox: Mailbox[int] = Mailbox(Bell(), 4, keep="oldest")
    answers = []
    server = Server(inbox, lambda raw: Request("key", b"", answers.append), lambda: inbox.put(1))

    server.close()

    assert answers == [None]
    assert not inbox.put(2)
