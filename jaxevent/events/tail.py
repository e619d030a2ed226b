"""The last events of a live stream."""

import numpy as np

from jaxevent.errors import InputError
from jaxevent.recording import Events


class Tail:
    """An `EventSource` that keeps only the last events of a stream, and the first one.

    Args:
        width: Width of the sensor, px.
        height: Height of the sensor, px.

    Attributes:
        count: Number of events so far.
        dropped: Number of events that are not kept.
        last: Time of the last event, us.
    """

    def __init__(self, width: int, height: int) -> None:
        self.checked_size = (width, height)
        self.count = self.dropped = 0
        self.last = np.iinfo(np.int64).min  # us
        self._first = Events.empty()
        self._parts: list[Events] = []

    def __len__(self) -> int:
        return self.count

    def add(self, events: Events) -> None:
        """Add events.

        Args:
            events: Events of the sensor, not earlier than those before.

        Raises:
            InputError: They are not valid events of the sensor, or earlier.
        """
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
            # A copy: the caller may use the memory of the events again.
            own = Events.of_checked(*(getattr(events, name).copy() for name in "txyp"))
            self._first = self._first if self.count else own[:1]
            self._parts.append(own)
            self.count += len(events)
            self.last = int(events.t[-1])

    def retained(self) -> Events:
        """Return the events from row `dropped` on."""
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
        return self.retained()[first - self.dropped : stop - self.dropped]

    def index(self, time: int) -> int:
        return self.dropped + self.retained().index(time)

    def drop(self, row: int) -> None:
        """Drop the events before a row."""
        kept = self.retained()[max(row - self.dropped, 0) :]
        # A copy: a slice would hold the array that it is of.
        self._parts = [Events.of_checked(*(getattr(kept, name).copy() for name in "txyp"))]
        self.dropped = max(row, self.dropped)
