"""Messages that arrive at a closed mailbox, and requests that arrive at a closed server."""

import pytest

from common.comms.mailbox import MAILBOX_BYTES, Bell, Mailbox
from common.comms.transport import Request, Server


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


def test_a_mailbox_holds_a_bounded_number_of_bytes():
    newest, oldest = (Mailbox(Bell(), 100, keep=keep) for keep in ("newest", "oldest"))
    size = MAILBOX_BYTES // 3
    kept = [[box.put(number, size) for number in range(5)] for box in (newest, oldest)]

    assert kept == [[True] * 5, [True, True, True, False, False]]
    assert (newest.take_all(), oldest.take_all()) == ([2, 3, 4], [0, 1, 2])
    assert (newest.dropped, oldest.dropped) == (2, 2)
    assert oldest.put(5, 2 * MAILBOX_BYTES)  # one message is always taken
