"""Hand-over between threads: a mailbox for the newest items, and an outlet that works them off."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from threading import Condition, Thread
from typing import Generic, TypeVar

from sliplens.progress import number_of

Item = TypeVar("Item")


class Mailbox(Generic[Item]):
    """Queue between two threads; where too many items wait, the oldest is lost and counted."""

    def __init__(self) -> None:
        self._changed, self._items = Condition(), deque[Item]()
        self.closed = False
        """True once no more items come; those that wait can still be taken."""
        self.lost = 0
        """Items that were left here and never taken."""

    def put(self, item: Item, *, most: int = 1) -> None:
        """Leave an item, in place of the oldest where so many wait; into a closed one it is lost."""
        with self._changed:
            if self.closed:
                self.lost += 1
                return
            while len(self._items) >= most:
                self._items.popleft()
                self.lost += 1
            self._items.append(item)
            self._changed.notify_all()

    def close(self, *, discard: bool = False) -> None:
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


@dataclass(frozen=True, kw_only=True)
class OutputState:
    """Progress of a recording or a sink."""

    name: str
    """Folder of the recording, or name of the sink."""
    sent: int
    """Frames that are on disk, or readings that the sink took."""
    lost: int
    """Frames or readings for which it was too slow, or that came after it failed."""
    seconds: float | None = None
    """Time that recorded frames span, in seconds; None of a sink."""
    trouble: str | None
    """Why it failed, with the cure; None while it works."""

    def __str__(self) -> str:
        sent = number_of(self.sent, "reading") + " sent"
        if self.seconds is not None:
            sent = f"{number_of(self.sent, 'frame')} in {self.seconds:.1f} s"
        lost = f", {self.lost:,} lost" if self.lost else ""
        trouble = f"; {self.trouble}" if self.trouble else ""
        return f"{self.name}: {sent}{lost}{trouble}"


class Outlet(Generic[Item]):
    """Thread that hands items on, one after another, so that their producer never waits.

    Parameters
    ----------
    name
        What it feeds, in messages.
    send
        Called with each item; after an exception nothing more is sent, and `error` is set.
    end
        Called once, in the same thread, when no more will be sent.
    most_bytes
        Size of the items that may wait; of more, the oldest is lost.
    cure
        Cure where it fails.
    """

    def __init__(
        self, name: str, send: Callable[[Item], None], end: Callable[[], None], *, most_bytes: int, cure: str
    ) -> None:
        self.name, self._send, self._end, self._most_bytes, self._cure = name, send, end, most_bytes, cure
        self.seconds: float | None = None
        """Time that recorded frames span, in seconds; None of a sink."""
        self._box: Mailbox[Item] = Mailbox()
        self.sent = 0
        """Items that were handed on."""
        self.error: Exception | None = None
        """Exception that ended it before it was closed."""
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def state(self) -> OutputState:
        """Current progress."""
        trouble, error = None, self.error
        if error is not None:
            reason = (error.strerror if isinstance(error, OSError) else None) or error
            items = number_of(self.sent, "reading" if self.seconds is None else "frame")
            trouble = f"{self.name} stopped after {items} ({reason}); {self._cure}"
        return OutputState(name=self.name, sent=self.sent, lost=self._box.lost, seconds=self.seconds, trouble=trouble)

    def put(self, item: Item, *, size_bytes: int) -> None:
        """Take an item, without waiting."""
        self._box.put(item, most=max(1, self._most_bytes // size_bytes))

    def close(self, patience_s: float) -> bool:
        """Take no more, and wait until all are handed on; False where that takes longer."""
        self._box.close()
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def discard(self) -> None:
        """Hand on nothing more."""
        self._box.close(discard=True)

    def _run(self) -> None:
        try:
            while (item := self._box.take()) is not None:
                self._send(item)
                self.sent += 1
        except Exception as error:  # any: the producer reports it
            self.error = error
            self._box.lost += 1
            self.discard()
        try:
            self._end()
        except Exception as error:
            self.error = self.error or error
