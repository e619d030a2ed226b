"""The last events of a stream that is still coming."""

import numpy as np

from jaxevent.errors import InputError
from jaxevent.recording import Events


class Tail:
    """An `EventSource` of which only the last events, and the very first one, are held."""

    def __init__(self, width: int, height: int) -> None:
        self.checked_size = (width, height)
        self.count = self.dropped = 0
        self.last = np.iinfo(np.int64).min  # us
        self._first = Events.empty()
        self._parts: list[Events] = []

    def __len__(self) -> int:
        return self.count

    def add(self, events: Events) -> None:
        """Add events of the sensor; raises `InputError` for bad or earlier ones."""
        if not isinstance(events, Events):
            raise InputError(
                f"the events added are a {type(events).__name__}; give jaxevent.Events(t, x, y, p)"
            )
        events.check(*self.checked_size, "the events added", self.count)
        if len(events) and events.t[0] < self.last:
            raise InputError(
                f"the events added begin at {events.t[0]} us, before the last one at {self.last} "
                "us; add them in order of time"
            )
        if len(events):
            # A copy: who gives events may use their memory again.
            own = Events.of_checked(*(getattr(events, name).copy() for name in "txyp"))
            self._first = self._first if self.count else own[:1]
            self._parts.append(own)
            self.count += len(events)
            self.last = int(events.t[-1])

    def held(self) -> Events:
        """Those from row `dropped` on."""
        if len(self._parts) != 1:
            parts = self._parts or [Events.empty()]
            joined = (np.concatenate([getattr(e, name) for e in parts]) for name in "txyp")
            self._parts = [Events.of_checked(*joined)]
        return self._parts[0]

    def __getitem__(self, rows: slice) -> Events:
        first, stop, _ = rows.indices(self.count)
        if (first, stop) == (0, 1):
            return self._first
        if first < self.dropped:
            raise IndexError(f"events before row {self.dropped} are gone")
        return self.held()[first - self.dropped : stop - self.dropped]

    def index(self, time: int) -> int:
        return self.dropped + self.held().index(time)

    def drop(self, row: int) -> None:
        """Forget the events before a row."""
        held = self.held()[max(row - self.dropped, 0) :]
        # A copy: a slice would hold the array that it is of.
        self._parts = [Events.of_checked(*(getattr(held, name).copy() for name in "txyp"))]
        self.dropped = max(row, self.dropped)
