import gc
import socket
import threading
import warnings
from contextlib import closing

from benchmarks.chaos.slow_wire import SlowWire
from deploy.prepare import free_port


def test_bytes_pass_and_nothing_is_left_open():
    with socket.create_server(("127.0.0.1", 0)) as hub, warnings.catch_warnings():
        warnings.simplefilter("error")
        port = free_port()

        def echo():
            connection, _ = hub.accept()
            with connection:
                connection.sendall(connection.recv(100))

        thread = threading.Thread(target=echo)
        thread.start()
        with closing(SlowWire(port, *hub.getsockname())):
            for _ in range(100):
                try:
                    client = socket.create_connection(("127.0.0.1", port), 0.5)
                    break
                except ConnectionRefusedError:  # its thread has not listened yet
                    threading.Event().wait(0.05)
            with client:
                client.sendall(b"ball")
                assert client.recv(100) == b"ball"
        thread.join(10)
        gc.collect()  # what is left open is an error now: pytest raises unraisable warnings
