"""How fast a generator publishes, and to which shards: the time is passed in."""


def shards_of(index: int, of: int, shards: int) -> tuple[int, ...]:
    """Return the shards that generator ``index`` of ``of`` fills; with more generators than shards they share."""
    if not 0 <= index < of:
        raise ValueError(f"generator index {index}; allowed are 0 to {of - 1}")
    return tuple(range(index, shards, of)) or (index % shards,)


class Pace:
    """Batches at a steady rate. Batches that were not needed while idle are not sent later.

    Args:
        rate_hz: Rallies per second.
        batch: Rallies per batch.
    """

    def __init__(self, rate_hz: float, batch: int) -> None:
        self._period = batch / rate_hz
        self._next = 0.0

    def due(self, now: float) -> bool:
        """Return whether a batch is due, and count it as sent if so."""
        if now < self._next:
            return False
        # A late batch shifts those that follow: a stall must not end in a burst.
        self._next = max(self._next + self._period, now)
        return True

    def wait(self, now: float) -> float:
        """Return how long until the next batch is due [s]."""
        return max(0.0, self._next - now)

    def idle(self, now: float) -> None:
        """Make the next batch due at once, since there is no subscriber now."""
        self._next = now
