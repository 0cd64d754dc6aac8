"""A TCP connection that can be made slow, or cut: bytes pass through this process on their way to the hub."""

import asyncio
import threading
from typing import Final

CHUNK: Final = 4096  # bytes
SLOW_BYTES_PER_S: Final = 65_536
SLOW_DELAY_S: Final = 0.2


class SlowWire:
    """Listens on a port and passes every connection on. Runs on a thread of its own.

    Args:
        port: Where it listens, on the loopback interface.
        host: Of the hub.
        hub_port: Of the hub.
    """

    def __init__(self, port: int, host: str, hub_port: int) -> None:
        self.is_slow = False
        self._writers: set[asyncio.StreamWriter] = set()
        self._port, self._target = port, (host, hub_port)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="wire", daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """End what is connected; who connects again gets through."""
        self._loop.call_soon_threadsafe(self._end_all)

    def _end_all(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    def close(self) -> None:
        """End."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._connect, "127.0.0.1", self._port))
        self._loop.run_forever()
        server.close()
        self._end_all()
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        self._loop.run_until_complete(asyncio.sleep(0.05))  # aborted connections close their sockets
        self._loop.close()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            hub_reader, hub_writer = await asyncio.open_connection(*self._target)
        except OSError:
            writer.close()
            return
        self._writers |= {writer, hub_writer}
        await asyncio.gather(self._pass(reader, hub_writer), self._pass(hub_reader, writer))
        self._writers -= {writer, hub_writer}

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(CHUNK):
                if self.is_slow:
                    await asyncio.sleep(SLOW_DELAY_S if len(data) < CHUNK else CHUNK / SLOW_BYTES_PER_S)
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            writer.close()
