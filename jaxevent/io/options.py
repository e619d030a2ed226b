"""The choices that a caller makes when a recording is read; every reader takes them."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class ReadOptions:
    """Choices of `jaxevent.io.load`, which describes each of them, for a reader.

    Attributes:
        size: (width, height) in pixels; None takes the size that the file states.
        in_memory: False leaves events and images in the file.
        progress: Whether to show a progress bar; None shows one on a terminal.
        stream: Name of the camera whose events are read; None where the file holds one.
        frames: Name of the images that become the frames; None lets the reader choose.
        without_frames: Whether frames are left out.
        without_events: Whether events are left out; frames are then those of a camera of its own.
        time_unit: Unit of the event times, "s", "ms", "us" or "ns"; None infers it.
        repair: Repairs of event times that go back; None refuses them.
        notes: Remarks that readers add, for `Recording.notes`.
    """

    size: tuple[int, int] | None = None
    in_memory: bool = True
    progress: bool | None = None
    stream: str | None = None
    frames: str | None = None
    time_unit: str | None = None
    repair: str | None = None
    without_frames: bool = False
    without_events: bool = False
    notes: list[str] = dataclasses.field(default_factory=list, compare=False)
