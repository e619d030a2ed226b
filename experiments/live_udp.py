"""Images of events that come over the network: a recording replayed by UDP on loopback.

    python experiments/live_udp.py [RECORDING] [--speed 1] [--window 131072]

One thread sends the recording's events, 13 bytes each, at their times (`--speed` times as fast);
the other adds them to `jaxevent.akf.live` and asks for the image of now every 20 ms of the
recording. Printed are how many events came, how late images were, how many events were held, and
how far the last image is from that of the whole recording.
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

RECORD = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
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


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    packaged = files("jaxevent") / "data/slider_depth_crop.h5"
    parser.add_argument("recording", nargs="?", default=packaged)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--window", type=int, default=1 << 17)
    arguments = parser.parse_args()
    recording = dataclasses.replace(jaxevent.load(arguments.recording), frames=None)
    size = recording.width, recording.height
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
    receiver.bind(("127.0.0.1", 0))
    # Programs are compiled before the first event comes.
    warm = jaxevent.akf.live(size, frames=False, window_events=arguments.window)
    warm.add(recording.events[: 3 * arguments.window])
    warm(warm.stop)
    live = jaxevent.akf.live(size, frames=False, window_events=arguments.window)
    port = receiver.getsockname()[1]
    threading.Thread(target=send, args=(recording, port, arguments.speed), daemon=True).start()
    count, held, due, late, image = 0, 0, recording.start, [], None
    for events in receive(receiver):
        live.add(events)
        count += len(events)
        held = max(held, len(live._events.held()))
        if live.stop >= due:
            clock = time.perf_counter()
            image = live(live.stop)
            late.append(time.perf_counter() - clock)
            due = live.stop + EVERY
    print(f"{count:,} of {len(recording.events):,} events came, at most {held:,} were held")
    middle, worst = 1e3 * np.median(late), 1e3 * max(late)
    print(f"{len(late)} images, median {middle:.1f} ms, worst {worst:.1f} ms")
    image = live(live.stop)
    whole = jaxevent.akf.estimate(recording)(live.stop)
    print(f"the last image is within {np.abs(image.mean - whole.mean).max():.1e} of the whole's")


if __name__ == "__main__":
    main()
