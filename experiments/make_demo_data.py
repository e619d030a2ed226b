"""Cut the recording that `jaxevent demo` uses out of slider_depth of the Event-Camera Dataset.

    python experiments/make_demo_data.py [slider_depth.zip]

Writes jaxevent/data/slider_depth_crop.h5: all pixels, 27 frames (an odd number, so that hiding
every second one leaves the last), while the camera moves at its full 0.3 m/s.
"""

import argparse
import dataclasses
import os
import sys
from pathlib import Path

import jaxevent
from jaxevent.io.output import complete

START, STOP = 500_000, 1_516_000  # us; the motion has its full speed from 0.2 s on
LARGEST = 1_800_000  # bytes, so that the package stays small
TARGET = Path(jaxevent.__file__).parent / "data" / "slider_depth_crop.h5"


def main() -> None:
    default = os.path.join(os.environ.get("JAXEVENT_DATA", "."), "data", "slider_depth.zip")
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="?", default=default, help="default: %(default)s")
    source = parser.parse_args().source
    try:
        recording = jaxevent.load(source)[START:STOP]
        recording = dataclasses.replace(recording, name=TARGET.stem)
        TARGET.parent.mkdir(exist_ok=True)
        with complete(TARGET) as partial:
            jaxevent.save(recording, partial, compression="gzip")
            size = partial.stat().st_size
            if size > LARGEST:
                raise jaxevent.InputError(f"{TARGET}: {size} bytes, above {LARGEST}; cut less")
    except jaxevent.InputError as error:
        sys.exit(f"make_demo_data: {error}")
    frames = recording.frames
    print(
        f"{TARGET}: {size:,} bytes, {len(recording.events):,} events, "
        f"{0 if frames is None else len(frames)} frames"
    )


if __name__ == "__main__":
    main()
