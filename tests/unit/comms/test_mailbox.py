"""What arrives when nobody takes it any more."""

import pytest

from common.comms.transport import Bell, Mailbox, Request, Server


@pytest.mark.parametrize("keep", ["newest", "oldest"])
def test_a_closed_mailbox_hands_over_what_waited_and_takes_nothing_in(keep):
    mailbox: Mailbox[int] = Mailbox(Bell(), 4, keep)
    mailbox.put(1)
    mailbox.put(2)

    assert mailbox.close() == [1, 2]

    assert not mailbox.put(3)
    assert mailbox.take() is None
    assert mailbox.dropped == 0


def test_a_request_that_arrives_as_its_server_closes_is_turned_away_or_refused():
    """Zenoh's threads may still deliver while, and after, a queryable is undeclared."""
    inbox: Mailbox[int] = Mailbox(Bell(), 4, keep="oldest")
    answers = []
    server = Server(inbox, lambda raw: Request("key", b"", answers.append), lambda: inbox.put(1))

    server.close()

    assert answers == [None]
    assert not inbox.put(2)
