"""Frequency with which the unit of event times is inferred wrongly, or doubted, on simulated files.

    python experiments/time_units.py

Each file has its own sensor, length, event rate, resolution and clock, drawn from a seed. Events
come in bursts of one pixel, as of moving edges, with a dead time, on a background of noise. A table
shows, for each unit and kind of number, the share of files whose unit is right, of those that are
wrong in silence, of those that warn, and of those that are refused.
"""

import warnings

import numpy as np

from jaxevent.errors import InputError, InputWarning
from jaxevent.io.checks import ReadOptions
from jaxevent.io.time_units import SAMPLE_EVENTS, US_PER_UNIT, infer_unit

SENSORS = [(64, 48), (128, 128), (240, 180), (346, 260), (640, 480), (1280, 720)]
FILES = 200  # of each row
LARGEST = 70_000  # events that are simulated; the count of longer files is what it would be


def simulate(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, tuple]:
    """Draw one file: times in seconds, x, y, the number of events in all, the sensor's size."""
    width, height = SENSORS[random.integers(len(SENSORS))]
    pixels = width * height
    span = 10 ** random.uniform(-1.5, 3.0)  # 30 ms to 17 min
    rate = 10 ** random.uniform(-1.5, 1.7)  # 0.03 to 50 events per pixel and second
    count = max(int(span * rate * pixels), 500)
    held = min(count, LARGEST)
    part = span * held / count
    bursts = max(held // 4, 1)
    begin = random.uniform(0, part, bursts)
    pixel = random.integers(0, pixels, bursts)
    size = random.poisson(3, bursts) + 1
    gap = 10 ** random.uniform(-3.7, -2.3)  # 0.2 to 5 ms between events of a burst
    which = np.repeat(np.arange(bursts), size)
    place = np.arange(len(which)) - np.repeat(np.cumsum(size) - size, size)
    t = begin[which] + place * gap * random.uniform(0.5, 1.5, len(which))
    noise = len(t) // 5
    if random.random() < 0.2:  # nothing but noise
        t, pixel, which = t[:0], pixel, which[:0]
        noise = held
    t = np.concatenate([t, random.uniform(0, part, noise)])
    pixel = np.concatenate([pixel[which], random.integers(0, pixels, noise)])
    order = np.argsort(t)
    t, pixel = t[order], pixel[order]
    if held < count:
        t = np.append(t[:SAMPLE_EVENTS], span)
        pixel = np.append(pixel[:SAMPLE_EVENTS], 0)
    offset = random.choice([0.0, 10 ** random.uniform(0, 5), 1.6e9 + random.uniform(0, 1e8)])
    return t + offset, pixel % width, pixel // width, max(count, len(t)), (width, height)


def stored(t: np.ndarray, unit: str, kind: str, random: np.random.Generator) -> np.ndarray:
    """Write times (s) in a unit: "whole", or "decimals" with the digits of a microsecond or all."""
    per_second = 1e6 / US_PER_UNIT[unit]
    if kind == "whole":
        if unit == "ns" and random.random() < 0.7:  # most sensors count microseconds
            return np.rint(t * 1e6).astype(np.int64) * 1000
        return np.rint(t * per_second).astype(np.int64)
    digits = 1 if unit == "us" else {"s": 6, "ms": 3}[unit]
    values = t * per_second
    return np.round(values, digits) if random.random() < 0.7 else values


def main() -> None:
    rows = [("us", "whole"), ("ns", "whole"), ("ms", "whole")]
    rows += [("s", "decimals"), ("ms", "decimals"), ("us", "decimals")]
    print(f"{'unit':4} {'kind':9} {'right':>7} {'silently wrong':>15} {'warned':>7} {'refused':>8}")
    for unit, kind in rows:
        right = wrong = warned = refused = 0
        for seed in range(FILES):
            random = np.random.default_rng([seed, ord(unit[0]), len(kind)])
            t, x, y, count, size = simulate(random)
            sample = {"t": stored(t, unit, kind, random), "x": x, "y": y}
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always", InputWarning)
                try:
                    found = infer_unit(sample, count, size, "file", ReadOptions()).name
                except InputError:
                    refused += 1
                    continue
            right += found == unit
            wrong += found != unit and not told
            warned += bool(told)
        shares = [100 * n / FILES for n in (right, wrong, warned, refused)]
        print(f"{unit:4} {kind:9} " + "{:6.1f}% {:14.1f}% {:6.1f}% {:7.1f}%".format(*shares))


if __name__ == "__main__":
    main()
