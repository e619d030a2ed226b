"""Two models of late events in place of one delay: events centred, and exposures not delayed.

    python experiments/delay_of_events.py --out delay

Objects of 20 ms at 300 px/s, seed 11, on the sensor's clock: MSE x 1e-2 of sharp images at the
frames' middles and halfway between them, by the delay of events. "as it is": the delay moves frames
and their exposures. "exposures kept": frames are deblurred with exposures at their own time.
"centred": each event is moved by half of the time to its pixel's event before or after, whichever
is shorter and at most 50 ms.
"""

import dataclasses
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
from common import command_line, markdown_table, write_text
from motion_compensated import (
    at_and_between,
    blurred_recordings,
    score_images,
    truth_of,
)

import jaxevent
from jaxevent.reconstruction.engine.bands import FrameRows, PartitionedRecording
from jaxevent.recording import Events, Recording

SEED = 11  # for choosing
DELAYS = (0.0, 0.001, 0.002, 0.003, 0.004)  # s
LONGEST_US = 50_000


def centred(recording: Recording) -> Recording:
    """Return the recording with each event in the middle of its change."""
    source = recording.events
    events = source[0 : len(source)]
    t = np.asarray(events.t)
    pixel = np.asarray(events.y).astype(np.int64) * recording.width + events.x
    order = np.argsort(pixel, kind="stable")
    gap = np.where(np.diff(pixel[order]) == 0, np.diff(t[order]).astype(float), np.inf)
    shorter = np.minimum(np.r_[np.inf, gap], np.r_[gap, np.inf])
    early = np.empty(len(t))
    early[order] = np.where(shorter <= LONGEST_US, shorter / 2, 0)
    moved = np.maximum(t - early, recording.start).astype(np.int64)
    rows = np.argsort(moved, kind="stable")
    made = Events(moved[rows], events.x[rows], events.y[rows], events.p[rows])
    return dataclasses.replace(recording, events=made)


def keep_exposures(read: Callable[..., FrameRows], late_us: float) -> Callable[..., FrameRows]:
    """Return a function that reads frames as `read` does, with exposures earlier."""

    def frames(self: PartitionedRecording, frame_range: slice) -> FrameRows:
        rows = read(self, frame_range)
        edges = {name: getattr(rows, name) - late_us for name in ("left", "mid", "right")}
        return rows._replace(**edges)

    return frames


def main() -> None:
    arguments = command_line(__doc__, out=True).parse_args()
    ((_, _, _), (_, source, recording)) = blurred_recordings(
        arguments.out, ((0.02,), (300.0,)), SEED
    )
    t, parts = at_and_between(recording)
    truth, rows = truth_of(source, t), []
    read = PartitionedRecording.frames
    for name in ("aks", "mc"):
        method: Any = getattr(jaxevent, name)
        params = method.Params.for_recording(recording).replace(clock_offset=0.0)
        for model in ("as it is", "exposures kept", "centred"):
            cells = []
            for delay in DELAYS:
                late = 1e6 * delay if model == "exposures kept" else 0.0
                given = centred(recording) if model == "centred" else recording
                with patch.object(PartitionedRecording, "frames", keep_exposures(read, late)):
                    one = score_images(
                        method, params.replace(event_delay=delay), given, truth, None, parts
                    )
                cells.append(f"{100 * one['at_frames']:.4f}, {100 * one['between']:.4f}")
            rows.append([name, model, *cells])
    head = ["", "events", *(f"{1e3 * delay:g} ms" for delay in DELAYS)]
    write_text(arguments.out / "delay.md", markdown_table(head, rows, 2) + "\n")


if __name__ == "__main__":
    main()
