"""What storing images costs, in CPU seconds and bytes, by the filter of HDF5 that compresses them.

    python experiments/storage.py

The images and variances of `akf` on the packaged slider_depth_crop at 200 Hz, chunks of one image,
as `jaxevent.show.export` stores them. Least CPU seconds of five, of this process alone.
"""

import tempfile
import time
from importlib.resources import files
from pathlib import Path

import h5py
import numpy as np

import jaxevent
from jaxevent.io.output import deflate_shuffled
from jaxevent.show.export import evenly_spaced_times

OPTIONS = {
    "none": {},
    "lzf": {"compression": "lzf"},
    "lzf, shuffle": {"compression": "lzf", "shuffle": True},
    "gzip 1": {"compression": "gzip", "compression_opts": 1},
    "gzip 1, shuffle": {"compression": "gzip", "compression_opts": 1, "shuffle": True},
}
OURS = "gzip 1, shuffle, as jaxevent writes it"
OPTIONS[OURS] = OPTIONS["gzip 1, shuffle"]


def main() -> None:
    recording = jaxevent.load(Path(str(files("jaxevent") / "data/slider_depth_crop.h5")))
    told = jaxevent.akf.estimate(recording, progress=False)(evenly_spaced_times(recording, 200))
    fields = [np.asarray(field, np.float32) for field in (told.mean, told.covariance)]
    print(f"{len(fields[0])} images of {recording.width}x{recording.height}, and variances")
    print("| filter | write, CPU s | read, CPU s | MB |")
    print("|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        for name, options in OPTIONS.items():
            writing, reading = [], []
            for _ in range(5):
                clock = time.process_time()
                with h5py.File(path, "w") as file:
                    for number, images in enumerate(fields):
                        chunks = (1, *images.shape[1:])
                        stored = file.create_dataset(
                            str(number), images.shape, "f4", chunks=chunks, **options
                        )
                        for row in range(len(images)):
                            if name == OURS:
                                stored.id.write_direct_chunk(
                                    (row, 0, 0), deflate_shuffled(images[row])
                                )
                            else:
                                stored[row] = images[row]
                writing.append(time.process_time() - clock)
                clock = time.process_time()
                with h5py.File(path) as file:
                    for stored in file.values():
                        assert isinstance(stored, h5py.Dataset)
                        stored[()]
                reading.append(time.process_time() - clock)
            size = path.stat().st_size / 1e6
            print(f"| {name} | {min(writing):.3f} | {min(reading):.3f} | {size:.2f} |")


if __name__ == "__main__":
    main()
