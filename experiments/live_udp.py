"""Images or tracks of events that come over the network: a recording replayed by UDP on loopback.

    python experiments/live_udp.py [RECORDING] [--speed 1] [--window 131072]
    python experiments/live_udp.py RECORDING --track [--preset slow]

One thread sends the recording's events, 13 bytes each, at their times (`--speed` times as fast);
the other adds them to `jaxevent.akf.live` and asks for the image of now every 20 ms of the
recording; with `--track` it adds them to `jaxevent.blob.moment.live` and asks for the targets.
Printed are how many events came, how late images were, how many events were held, and how far the
last answer is from that of the whole recording.
"""

import argparse
import dataclasses
import socket
import threading
import time
from importlib.resources import files

import numpy as np

import jaxevent
from jaxevent.recording import Events, Recording

RECORD: np.dtype = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
MOST = 4000  # events in a datagram: 52,000 bytes
EVERY = 20_000  # us between images


def send(recording: Recording, port: int, speed: float) -> None:
    events, sender = recording.events[:], socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    records, began, first = events.to_structured(), time.perf_counter(), int(events.t[0])
    row = 0
    while row < len(records):
        now = first + (time.perf_counter() - began) * 1e6 * speed
        due = min(int(np.searchsorted(events.t, now)), row + MOST)
        if due > row:
            sender.sendto(records[row:due].tobytes(), ("127.0.0.1", port))
            row = due
        else:
            time.sleep(0.0005)
    sender.sendto(b"", ("127.0.0.1", port))


def receive(receiver: socket.socket):
    """Events, one datagram after another, to an empty one."""
    while datagram := receiver.recv(1 << 16):
        records = np.frombuffer(datagram, RECORD)
        yield Events(*(np.ascontiguousarray(records[name]) for name in "txyp"))


class Images:
    """Current image, by the AKF."""

    def __init__(self, recording: Recording, arguments: argparse.Namespace):
        size = recording.width, recording.height
        self.recording, self.window = recording, arguments.window
        self.live = jaxevent.akf.live(size, frames=False, window_events=arguments.window)

    def compile_programs(self) -> None:
        self.live.add(self.recording.events[: 3 * self.window])
        self.live(self.live.stop)

    def n_held(self) -> int:
        return len(self.live._events.retained())

    def compare_with_whole(self) -> str:
        image = self.live(self.live.stop).mean
        whole = jaxevent.akf.estimate(self.recording, jaxevent.akf.Params())(self.live.stop).mean
        return f"the last image is within {np.abs(image - whole).max():.1e} of the whole's"


class Targets:
    """Current targets, by the moment filter."""

    def __init__(self, recording: Recording, arguments: argparse.Namespace):
        self.recording = recording
        self.params = jaxevent.blob.moment.Params(preset=arguments.preset)
        self.live = jaxevent.blob.moment.live((recording.width, recording.height), self.params)

    def compile_programs(self) -> None:
        self.live.add(self.recording.events[:10_000])
        self.live(self.live.stop)

    def n_held(self) -> int:
        return len(self.live._tail.retained())

    def compare_with_whole(self) -> str:
        t = self.live.stop
        now = self.live(t)
        tracks = jaxevent.blob.moment.estimate(self.recording, self.params, smooth=False)
        whole = tracks(t)
        shown = whole.valid[0] & (tracks.confirmed <= t)
        if len(now.id) != shown.sum():
            return f"{len(now.id)} targets at the end, {shown.sum()} of the whole recording"
        apart = np.abs(now.mean[0, :, :2] - whole.mean[0, shown, :2])
        return (
            f"{len(now.id)} targets at the end, the whole's within {apart.max(initial=0):.1e} px; "
            f"{self.live._n_ids} in all, {len(tracks)} of the whole"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    packaged = files("jaxevent") / "data/slider_depth_crop.h5"
    parser.add_argument("recording", nargs="?", default=packaged)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--window", type=int, default=1 << 17)
    parser.add_argument("--track", action="store_true", help="targets instead of images")
    parser.add_argument("--preset", help="of the tracker's parameters")
    arguments = parser.parse_args()
    recording = dataclasses.replace(jaxevent.load(arguments.recording), frames=None)
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
    receiver.bind(("127.0.0.1", 0))
    made = Targets if arguments.track else Images
    made(recording, arguments).compile_programs()  # before events come
    estimate = made(recording, arguments)
    live = estimate.live
    port = receiver.getsockname()[1]
    threading.Thread(target=send, args=(recording, port, arguments.speed), daemon=True).start()
    count, n_held, due, late, spent = 0, 0, recording.start, [], time.process_time()
    for events in receive(receiver):
        live.add(events)
        count += len(events)
        n_held = max(n_held, estimate.n_held())
        if live.stop >= due:
            clock = time.perf_counter()
            live(live.stop)
            late.append(time.perf_counter() - clock)
            due = live.stop + EVERY
    spent = time.process_time() - spent
    print(f"{count:,} of {len(recording.events):,} events came, at most {n_held:,} were held")
    middle, worst = 1e3 * np.median(late), 1e3 * max(late)
    print(
        f"{len(late)} answers, median {middle:.1f} ms, worst {worst:.1f} ms; {spent:.1f} s of CPU"
    )
    print(estimate.compare_with_whole())


if __name__ == "__main__":
    main()
