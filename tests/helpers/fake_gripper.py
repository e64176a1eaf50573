"""A gripper that misbehaves."""

import socket
import threading
from collections.abc import Callable
from contextlib import suppress


class FakeGripper:
    """A gripper on a port of this machine that speaks the line protocol, or as badly as it is told to."""

    def __init__(self) -> None:
        self.answer: bytes | Callable[[str], bytes | None] | None = b"OK 1.000 0.0400\n"
        self.heard: list[str] = []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        with suppress(OSError):  # until it is closed
            while True:
                self._connection, _ = self._server.accept()
                # whoever hangs up in the middle of an answer resets the connection
                with suppress(ConnectionError), self._connection, self._connection.makefile("rwb") as stream:
                    for line in stream:
                        told = self.answer  # first: another one may be set once it has heard
                        self.heard.append(words := line.decode().strip())
                        answer = told(words) if callable(told) else told
                        if answer is not None:
                            stream.write(answer)
                            stream.flush()

    def hang_up(self) -> None:
        """End the connection; another one may be made."""
        self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        with suppress(OSError):  # closed already
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
