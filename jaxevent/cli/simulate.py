"""The command `jaxevent simulate`."""

import contextlib
import math
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, print_stored
from jaxevent.errors import InputError


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Make a recording whose truth is known, as HDF5. A simulated sensor looks at a drawn scene "
        "of high dynamic range over which the camera moves, at objects that move on their own, or "
        "at a video, of which the frames see only the middle levels. Or events alone, of moving "
        "blobs. Or a camera that moves in a rigid world.",
        "--scene lake --speed fast --out lake.h5",
        "--objects --speed 200 --seed 1 --out objects.h5",
        "--blobs lissajous --truth dot.csv --out dot.h5",
        "--motion rotation --change varying --truth spin.csv --out spin.h5",
        "bike.mp4 --cut 50 --speed 0.5 --out bike.h5",
    )
    source = one.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "video", metavar="VIDEO", nargs="?", type=Path, help="a video, or a folder of images"
    )
    source.add_argument(
        "--scene",
        metavar="NAME",
        help="room, forest, mountain, lake, night, tunnel, or a number for a variant of one",
    )
    source.add_argument(
        "--objects", action="store_true", help="five textured objects before a moving background"
    )
    source.add_argument(
        "--blobs",
        metavar="NAME",
        help="lissajous, noise, growing, ttc, disc, crossing, dropout, flock or walk",
    )
    source.add_argument(
        "--motion",
        metavar="NAME",
        help="motion of the camera: planar, rotation, or general before a wall, shapes or texture",
    )
    _add_settings(one)


def _add_settings(one: Any) -> None:
    arguments.add_output(one, "--out", metavar="FILE", required=True, help="the HDF5 file to write")
    one.add_argument(
        "--sensor",
        metavar="NAME",
        help="ideal, good, davis or poor; default: davis, with --motion an ideal one",
    )
    one.add_argument("--seed", metavar="N", type=int, default=0, help="seed of random numbers")
    one.add_argument(
        "--speed",
        metavar="SPEED",
        help="of the camera over a scene, slow (default) or fast; of --objects, px/s, default 90; "
        "of a video, 2: twice as fast; of --motion, px/s (planar), rad/s (rotation) or m/s",
    )
    one.add_argument(
        "--duration",
        metavar="S",
        type=float,
        help="seconds of a scene, default 1.5, of --objects, default 1, or of --motion, default "
        "0.5; of the video, before --speed, or of blobs, default all",
    )
    arguments.add_output(
        one,
        "--truth",
        metavar="CSV",
        help="a table at 1000 Hz: of blobs their states, as that of `jaxevent track`, of --motion "
        "the motion, as that of `jaxevent motion`",
    )
    one.add_argument(
        "--size",
        metavar="W,H",
        type=arguments.size,
        help="sensor size in pixels; default: 128,96 for a scene, 160,120 for --objects, 240,180 "
        "for --motion",
    )
    group = one.add_argument_group("only for --motion")
    group.add_argument(
        "--change",
        metavar="HOW",
        help="change of the motion over time: constant (default), linear or varying",
    )
    group = one.add_argument_group("only for a video")
    group.add_argument("--start", metavar="S", type=float, help="first second used; default: 0")
    group.add_argument(
        "--cut",
        metavar="LEVELS",
        type=float,
        help="levels of 255 that the frames crop at either end, 0 to 127; default: 50",
    )
    group.add_argument(
        "--max-size",
        metavar="PIXELS",
        type=int,
        help="longer side, to which a larger video is scaled down; default: 346",
    )


def run(
    *,
    video: Path | None,
    scene: str | None,
    objects: bool,
    blobs: str | None,
    motion: str | None,
    change: str | None,
    truth: Path | None,
    out: Path,
    sensor: str | None,
    seed: int,
    speed: str | None,
    duration: float | int | None,
    size: tuple[int, int] | None,
    start: float | int | None,
    cut: float | int | None,
    max_size: int | None,
) -> None:
    from jaxevent.io.output import check_recording_name
    from jaxevent.parameters import check_choice
    from jaxevent.simulate import SENSORS

    check_recording_name(out)
    arguments.check_seed(seed)
    if duration is not None and not 0 < duration < math.inf:
        raise InputError(f"--duration {duration:g} is not possible; give seconds above 0")
    if size is not None and min(size) < 1:
        raise InputError(f"--size {size[0]},{size[1]} is not possible; give it in pixels")
    if sensor is not None:
        check_choice(sensor, "sensor", SENSORS)
    of_video = {"start": start, "cut": cut, "max-size": max_size}
    if blobs is not None:
        own = {"sensor": sensor, "speed": speed, "size": size, "change": change}
        _refuse_options("is not for blobs; leave it out", **of_video, **own)
        return _simulate_blobs(blobs, truth, out, seed, duration)
    if motion is not None:
        _refuse_options("is not for the motion of a camera; leave it out", **of_video)
        how = {"change": change or "constant", "sensor": sensor, "speed": speed}
        return _simulate_motion(
            motion, truth, out, seed, duration or 0.5, size or (240, 180), **how
        )
    what = "that of --blobs and --motion; HDR scenes hold theirs, leave it out"
    _refuse_options(f"is {what}", truth=truth)
    _refuse_options("is for --motion; leave it out", change=change)
    chosen = SENSORS[sensor or "davis"]
    if video is not None:
        _refuse_options("is for a scene or --objects; scale a video with --max-size", size=size)
        given = {name.replace("-", "_"): v for name, v in of_video.items() if v is not None}
        return _simulate_video(
            video, out, sensor=chosen, seed=seed, speed=speed, duration=duration, given=given
        )
    what = "--objects" if objects else "--scene"
    _refuse_options(f"is for a video; leave it out with {what}", **of_video)
    _simulate_scene(scene, out, sensor=chosen, seed=seed, speed=speed, duration=duration, size=size)


def _refuse_options(why: str, **given: Any) -> None:
    """Raise `InputError` if any of these options is given."""
    for name, value in given.items():
        if value is not None:
            raise InputError(f"--{name} {why}")


def _simulate_video(
    video: Path,
    out: Path,
    *,
    sensor: Any,
    seed: int,
    speed: str | None,
    duration: float | int | None,
    given: dict[str, Any],
) -> None:
    from jaxevent import simulate as sim
    from jaxevent.io import save
    from jaxevent.io.output import complete

    if not video.exists():
        raise InputError(
            f"{video}: there is no such video or folder of images; correct the path, or give a "
            "scene by --scene, --objects, --blobs or --motion"
        )
    try:
        factor = float(speed or 1)
    except ValueError:
        raise InputError(
            f"--speed {speed} is for a scene; give a video a number, such as 0.5"
        ) from None
    stop = None if duration is None else given.get("start", 0.0) + duration
    # Opened first, so that a place that cannot be written is reported before the work.
    with complete(out) as partial:
        recording = sim.from_video(video, sensor, speed=factor, stop=stop, seed=seed, **given)
        save(recording, partial)
    print_stored(recording, out)


def _simulate_scene(
    scene: str | None,
    out: Path,
    *,
    sensor: Any,
    seed: int,
    speed: str | None,
    duration: float | int | None,
    size: tuple[int, int] | None,
) -> None:
    """Simulate a camera that pans over a scene; without a scene, moving objects.

    Args:
        scene: Number or name of a scene; None: moving objects.
        out: File to write.
        sensor: `jaxevent.simulate.Sensor`, the properties of the camera.
        seed: Seed of the noise, and of the objects.
        speed: "slow" or "fast" for a scene, px/s for objects; None: slow, or 90 px/s.
        duration: s; None: 1.5 for a scene, 1 for objects.
        size: (width, height), px; None: (128, 96) for a scene, (160, 120) for objects.
    """
    from jaxevent import simulate as sim
    from jaxevent.io import save
    from jaxevent.io.output import complete
    from jaxevent.simulate.scenes import PAN_SPEEDS_PX_S

    with complete(out) as partial:
        if scene is None:
            pace = _parse_speed(speed, "200") or 90.0
            source = sim.MovingObjects(size or (160, 120), duration or 1.0, pace, seed=seed)
            name = "objects"
        else:
            way: Any = speed or "slow"
            if way not in PAN_SPEEDS_PX_S:
                raise InputError(f"--speed {way} is not possible for a scene; give slow or fast")
            panorama = sim.scene(int(scene) if scene.isdecimal() else scene)
            source = sim.Pan(panorama, size or (128, 96), duration or 1.5, way, seed)
            name = f"{scene}-{way}"
        recording = sim.simulate(source, sensor, seed, name)
        save(recording, partial)
    print_stored(recording, out)


def _simulate_blobs(
    name: str, truth: Path | None, out: Path, seed: int, duration: float | int | None
) -> None:
    import numpy as np

    from jaxevent.io import save
    from jaxevent.io.output import complete
    from jaxevent.show.track_tables import write_states
    from jaxevent.simulate import blob_scene

    with contextlib.ExitStack() as stack:
        partial = stack.enter_context(complete(out))
        table = None if truth is None else stack.enter_context(complete(truth))
        recording, states = blob_scene(name, seed)
        if duration is not None and duration < states.duration:
            recording = recording[: float(duration)]
        save(recording, partial)
        if table is not None:
            times = np.arange(0, recording.stop + 1, 1000)
            write_states(table, times, states(times), states.visible(times))
    print_stored(recording, out)


def _parse_speed(speed: str | None, example: str) -> float | None:
    """Convert --speed to a number; raise `InputError` unless it is above 0."""
    try:
        pace = None if speed is None else float(speed)
    except ValueError:
        pace = math.nan
    if pace is not None and not 0 < pace < math.inf:
        raise InputError(
            f"--speed {speed} is not possible; give a number above 0, such as {example}"
        )
    return pace


def _simulate_motion(
    name: str,
    truth: Path | None,
    out: Path,
    seed: int,
    duration: float | int,
    size: tuple[int, int],
    *,
    change: str,
    sensor: str | None,
    speed: str | None,
) -> None:
    import numpy as np

    from jaxevent.egomotion.models import MODELS, General
    from jaxevent.io import save
    from jaxevent.io.output import complete
    from jaxevent.show.motion import write_known_motion
    from jaxevent.simulate import SENSORS, motion_scene

    pace = _parse_speed(speed, "1.5")
    with contextlib.ExitStack() as stack:
        partial = stack.enter_context(complete(out))
        table = None if truth is None else stack.enter_context(complete(truth))
        # The field of view is always that of 240 px and f = 200 px.
        recording, source = motion_scene(
            name, change, seed, size=size, focal=size[0] / 1.2, duration=duration, speed=pace,
            sensor=None if sensor is None else SENSORS[sensor],
        )  # fmt: skip
        save(recording, partial)
        if table is not None:
            times = np.arange(0, round(1e6 * duration) + 1, 1000)
            # Scenes that are not named after a model have general motion.
            model = MODELS.get(name, General)
            write_known_motion(table, model, times, model.from_scene(source, times))
    print_stored(recording, out)
