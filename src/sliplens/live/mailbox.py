"""Hand-over between threads: a mailbox for the newest items, and an outlet that works them off."""

from collections import deque
from collections.abc import Callable
from threading import Condition, Thread
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Mailbox(Generic[Item]):
    """Queue between two threads; where more wait than `most_bytes` holds, the oldest is lost and counted."""

    def __init__(self, *, most_bytes: int = 1) -> None:
        self._changed, self._items, self._most_bytes = Condition(), deque[Item](), most_bytes
        self.closed = False
        """True once no more items come; those that wait can still be taken."""
        self.lost = 0
        """Items that were left here and never taken."""

    def put(self, item: Item, *, size_bytes: int = 1) -> None:
        """Leave an item, in place of the oldest where too many wait; into a closed one it is lost."""
        with self._changed:
            if self.closed:
                self.lost += 1
                return
            while len(self._items) >= max(1, self._most_bytes // size_bytes):
                self._items.popleft()
                self.lost += 1
            self._items.append(item)
            self._changed.notify_all()

    def shut(self, *, discard: bool = False) -> None:
        """Wake the waiting thread: no more items come; with `discard` those that wait are lost."""
        with self._changed:
            self.closed = True
            if discard:
                self.lost += len(self._items)
                self._items.clear()
            self._changed.notify_all()

    def take(self, timeout_s: float | None = None) -> Item | None:
        """Wait for the oldest item; None where none came in time, or none will come any more."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self.closed, timeout_s)
            return self._items.popleft() if self._items else None


class Outlet(Mailbox[Item]):
    """Thread that hands frames or readings on, one after another, so that their producer never waits.

    Parameters
    ----------
    name
        Folder of the recording, or name of the sink.
    send, end
        Called with each item, and once no more is sent; after an exception of `send` nothing more is.
    most_bytes
        Size of the items that may wait; of more, the oldest is lost.
    """

    verb = "sent"
    """Action with an item, in messages."""
    cure = "start it again"

    def __init__(self, name: str, *, send: Callable[[Item], None], end: Callable[[], None], most_bytes: int) -> None:
        super().__init__(most_bytes=most_bytes)
        self._send, self._end, self.name, self.sent = send, end, name, 0
        """Number of frames that are on disk, or of readings that the sink took."""
        self.error: Exception | None = None
        """Exception that ended it before it was closed."""
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def __str__(self) -> str:
        lost = f", {self.lost:,} lost" if self.lost else ""
        return f"{self.name}: {self.sent:,} {self.verb}{lost}{f'; {self.trouble}' if self.trouble else ''}"

    @property
    def trouble(self) -> str | None:
        """Why it failed, with the cure; None while it works."""
        if self.error is None:
            return None
        reason = (self.error.strerror if isinstance(self.error, OSError) else None) or self.error
        return f"{self.name} stopped after {self.sent:,} were {self.verb} ({reason}); {self.cure}"

    def finish(self, patience_s: float) -> bool:
        """Take no more, and wait until all are handed on; False where that takes longer."""
        self.shut()
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while (item := self.take()) is not None:
                self._send(item)
                self.sent += 1
        except Exception as error:  # any: the producer reports it
            self.error = error
            self.lost += 1
            self.shut(discard=True)
        try:
            self._end()
        except Exception as error:
            self.error = self.error or error
