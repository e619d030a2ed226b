"""Columns and images of other libraries as plain NumPy arrays, and checks of the values in them.

An array-like is a list, or anything that answers NumPy's array protocol (`__array__`) or DLPack
(`__dlpack__`): arrays of NumPy and JAX, tensors of PyTorch, columns of pandas, polars and Arrow.
None of these libraries is imported. Plain arrays are of the machine's byte order, contiguous and
writable, as compiled functions take them; an array that is plain already is not copied.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from jaxevent.display import describe_type
from jaxevent.errors import InputError, InputWarning

TimeUnit = Literal["s", "ms", "us", "ns"]

FIELD_ALIASES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps", "time_stamp"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on"),
}
LUMA_WEIGHTS = np.array([0.299, 0.587, 0.114])  # of red, green and blue, ITU-R 601
MAX_SIDE_PX = 1 << 16  # of a side: coordinates are uint16
MAX_LEVEL = 65535  # white of images of uint16
MAX_TIME_US = 1 << 62  # 146,000 years: sums and differences of two times stay in int64
UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
US_PER_UNIT: dict[str, float] = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}  # us in one unit
_LUMA_WEIGHTS_2_16 = (19595, 38470, 7471)  # times 2^-16, as Pillow computes grey
_MAX_STEP_US = 1000.0  # between neighbouring numbers of a type, from which it is refused
_MIN_TIME_STEPS = 64  # of a type within the span of the events
_USUAL_BITS = (8, 10, 12)  # of a camera whose levels are stored as uint16
_JUDGED_IMAGES = 64  # whose largest level is compared with these
_MIN_JUDGED_EVENTS = 300  # from which events must span `_MIN_TIME_STEPS`
_BLOCK_VALUES = 1 << 20  # values compared together, so that a check needs no memory to speak of
_REMEDY_OF_KIND = {
    "O": "convert it to numbers",
    "U": "convert the text to numbers",
    "S": "convert the text to numbers",
    "c": "give its real part",
    "M": "give .astype('datetime64[us]').astype('int64'), microseconds",
    "m": "give .astype('timedelta64[us]').astype('int64'), microseconds",
    "V": "give one field of it, or the whole array as the only argument of from_arrays",
}


def find_fields(names: Sequence[str]) -> dict[str, str] | None:
    """Find the names of t, x, y and p among some; None unless each is there, once."""
    found = {}
    for field, aliases in FIELD_ALIASES.items():
        fitting = [name for name in names if str(name).strip().lower() in aliases]
        if len(fitting) != 1:
            return None
        found[field] = fitting[0]
    return found


def as_array(values: Any, what: str) -> NDArray:
    """Turn an array-like into a NumPy array.

    Args:
        values: Numbers of any shape, bool, integer or float.
        what: Name of the argument for messages.

    Returns:
        The numbers as an array, not copied if it is one.

    Raises:
        InputError: The values are no numbers, or some are missing.
    """
    missing = np.nonzero(np.atleast_1d(_find_missing(values)))[0]
    if len(missing):
        raise InputError(
            f"{what} has no value in row {missing[0]}; remove such rows from all columns, or fill "
            "them in"
        )
    if isinstance(values, np.ma.MaskedArray):
        values = values.data
    if isinstance(values, str | bytes | Mapping | set | frozenset) or (
        not hasattr(values, "__array__") and isinstance(values, Iterable) and _is_spent(values)
    ):
        raise InputError(f"{what} is a {type(values).__name__}; give an array or a list of numbers")
    try:
        only_dlpack = hasattr(values, "__dlpack__") and not hasattr(values, "__array__")
        array = np.from_dlpack(values) if only_dlpack else np.asarray(values)
    except Exception as error:  # whatever the library of the array raises
        reason = " ".join(str(error).split())[:150] or type(error).__name__
        raise InputError(
            f"{what}, a {type(values).__name__}, cannot be read as a NumPy array ({reason}); give "
            "one on the CPU, without a gradient, whose rows are equally long"
        ) from None
    if array.dtype.kind not in "biuf":
        remedy = _REMEDY_OF_KIND.get(array.dtype.kind, "convert it to numbers")
        raise InputError(f"{what} is of type {array.dtype}, not numbers; {remedy}")
    return array


def _find_missing(values: Any) -> Any:
    """Return a mask of the values that a masked array or a column of a table lacks."""
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.getmaskarray(values)
    for name in ("isna", "is_null"):  # of pandas; of polars and Arrow
        find = None if isinstance(values, type) else getattr(values, name, None)
        if callable(find):
            return np.asarray(find())
    return np.zeros(0, bool)


def _is_spent(values: Iterable[Any]) -> bool:
    """Return whether an iterable has no order or can be passed over only once."""
    return not (hasattr(values, "__len__") and hasattr(values, "__getitem__"))


def as_column(values: Any, what: str) -> NDArray:
    """Turn an array-like of one axis into a NumPy array.

    Args:
        values: (n,) numbers, bool, integer or float.
        what: Name of the argument for messages.

    Returns:
        (n,) numbers.

    Raises:
        InputError: The values have another shape or are no numbers.
    """
    array = as_array(values, what)
    if array.ndim != 1:
        remedy = (
            "give np.ravel of it" if array.size == max((*array.shape, 1)) else "give one column"
        )
        raise InputError(f"{what} has the shape {array.shape}, not (n,); {remedy}")
    return array


def as_plain(values: NDArray, dtype: Any = None) -> NDArray:
    """Return an array of the machine's byte order, contiguous and writable.

    Args:
        values: The array, which is not copied if it is plain already.
        dtype: Type of the result; None keeps that of `values`.

    Returns:
        The plain array.
    """
    dtype = values.dtype.newbyteorder("=") if dtype is None else np.dtype(dtype)
    return np.require(values, dtype, "CAWE")


def columns_of(events: Any) -> dict[str, Any]:
    """Return the columns t, x, y and p of a structured array, a DataFrame, a table or a dictionary.

    Raises `InputError` if these are not found by their names (`FIELD_ALIASES`).
    """
    names: Any = getattr(getattr(events, "dtype", None), "names", None)
    if names is None and isinstance(events, Mapping):
        names = list(events)
    for attribute in ("column_names", "columns"):  # of Arrow; of pandas and polars
        if names is None and not isinstance(events, np.ndarray):
            names = getattr(events, attribute, None)
    if names is None and all(hasattr(events, name) for name in "txyp"):
        return {name: getattr(events, name) for name in "txyp"}
    try:
        fields = None if names is None else find_fields(list(names))
    except TypeError:
        names = fields = None
    if fields is None:
        shape = getattr(events, "shape", None)
        held = f"of shape {shape}" if shape is not None else ""
        if names is not None:
            held = f"with {', '.join(map(str, names))[:80] or 'no columns'}"
        raise InputError(
            f"events, {describe_type(events)} {held}".rstrip()
            + ", has no columns named t, x, y and p; give each on its own: "
            "from_arrays(t, x, y, p, width=..., height=...)"
        )
    return {field: events[name] for field, name in fields.items()}


def check_unit(time_unit: Any) -> None:
    """Raise `InputError` unless a unit of time is "s", "ms", "us" or "ns", or None."""
    if time_unit is not None and time_unit not in get_args(TimeUnit):
        raise InputError(
            f"time_unit = {shorten_value(time_unit)} is not a unit of time; "
            "give 's', 'ms', 'us' or 'ns'"
        )


def as_times(values: Any, what: str, time_unit: TimeUnit | None = None) -> NDArray[np.int64]:
    """Convert the times of a caller to plain int64 us.

    Args:
        values: (n,) times.
        what: Name of the argument for messages.
        time_unit: Unit of the times, "s", "ms", "us" or "ns"; None has integers in us and refuses
            floats.

    Returns:
        (n,) times in us. Times that their type rounds by more than 1 us raise an `InputWarning`.

    Raises:
        InputError: The times are no numbers, have no unit, or their type cannot resolve them.
    """
    t = as_column(values, what)
    if t.dtype.kind == "b" and len(t):
        raise InputError(f"{what} is of type bool, not times; give integers or floats")
    if t.dtype.kind == "f" and time_unit is None and len(t):
        raise InputError(
            f"{what} is {t.dtype}, which states no unit; give time_unit='s' (or 'ms', 'us', 'ns'), "
            "or integer microseconds"
        )
    unit = time_unit or "us"
    if t.dtype.kind == "f" and len(t) and np.isfinite(t).all():
        first, last = float(t.min()), float(t.max())
        spread = (time_step(t), last - first, max(abs(first), abs(last)))
        if (note := check_resolution(spread, len(t), unit, what)) is not None:
            warnings.warn(f"{what}: {note}", InputWarning, stacklevel=3)
    elif unit != "us":
        check_span(t, what, "row", max(round(US_PER_UNIT[unit]), 1))
    return as_plain(to_microseconds(t, unit, what, "row") if len(t) else t, np.int64)


def time_step(t: NDArray) -> float:
    """Return the distance between neighbouring numbers near the largest value of a column.

    Numbers of a wider type that all are numbers of 32 bits were rounded to these before.

    Args:
        t: (n,) finite times.

    Returns:
        The distance in the unit of `t`; 0 for integers.
    """
    if t.dtype.kind != "f" or not len(t):
        return 0.0
    largest = np.abs(t).max().astype(np.float64)
    step = float(np.spacing(t.dtype.type(largest)))
    if t.dtype.itemsize > 4 and len(t) > 16 and largest < 3e38:
        decimals = t[t != np.rint(t)]
        if len(decimals) > 16 and (decimals.astype(np.float32) == decimals).all():
            # Multiples of a large binary fraction, such as halves, are numbers of any type.
            if (decimals * 1024 != np.rint(decimals * 1024)).any():
                return float(np.spacing(np.float32(largest)))
    return step


def check_resolution(extremes: Sequence[float], count: int, unit: str, source: str) -> str | None:
    """Check that the type of float times resolves events.

    Times are refused where neighbouring numbers of their type are 1 ms or more apart, or where 300
    or more events span fewer than 64 of them.

    Args:
        extremes: Distance between neighbouring numbers as of `time_step`, time from the first to
            the last event, and largest time, all in a unit.
        count: Number of events.
        unit: The unit, "s", "ms", "us" or "ns".
        source: Name of the file for messages.

    Returns:
        A sentence on times rounded by more than 1 us; None where they are not.

    Raises:
        InputError: The type cannot resolve the times.
    """
    step_us, span_us, largest_us = (value * US_PER_UNIT[unit] for value in extremes)
    if step_us <= 1 or count < 2 or not largest_us < MAX_TIME_US:
        return None
    if step_us >= _MAX_STEP_US or (
        count >= _MIN_JUDGED_EVENTS and span_us < _MIN_TIME_STEPS * step_us
    ):
        raise InputError(
            f"{source}: the type of the times cannot resolve them: as {UNIT_NAMES[unit]} its "
            f"numbers near {_short_time(largest_us)} are {_short_time(step_us)} apart; store "
            "integer microseconds or 64-bit floats, counted from the start of the recording"
        )
    return f"times are rounded by their type to {_short_time(step_us)}"


def _short_time(us: float) -> str:
    if us < 1e3:
        return f"{us:.3g} us"
    return f"{us / 1e3:.3g} ms" if us < 1e6 else f"{us / 1e6:.10g} s"


def times(
    values: NDArray, source: str, what: str, us_per_unit: float = 1e6, first_row: int = 0
) -> NDArray[np.int64]:
    """Convert times of a file to int64 us: integers are us already, floats are scaled.

    Args:
        values: (n,) times.
        source: Name of the file for messages.
        what: "event", "image" or the like.
        us_per_unit: Microseconds in one unit of floats.
        first_row: Row of the first time in the file.

    Returns:
        (n,) times in us.

    Raises:
        InputError: A time is not finite or too large.
    """
    values = numbers(values, source, f"{what} times")
    is_float = values.dtype.kind == "f"
    values = values.astype(np.float64, copy=False) if is_float else values
    check_span(values, source, what, us_per_unit if is_float else 1, first_row)
    if not is_float:
        return values.astype(np.int64, copy=False)
    return np.rint(values * us_per_unit).astype(np.int64)


def to_microseconds(
    values: NDArray, unit: str, source: str, what: str, first_row: int = 0
) -> NDArray[np.int64]:
    """Convert times of a unit to int64 us.

    Args:
        values: (n,) times.
        unit: "s", "ms", "us" or "ns"; nanoseconds are rounded.
        source: Name of the file for messages.
        what: "event", "image" or the like.
        first_row: Row of the first time in the file.

    Returns:
        (n,) times in us.

    Raises:
        InputError: A time is not finite or too large for us.
    """
    if values.dtype.kind not in "iu" or unit == "us":
        return times(values, source, what, US_PER_UNIT[unit], first_row)
    wide = values if values.dtype == np.uint64 else values.astype(np.int64)
    if unit == "ns":
        whole, rest = np.divmod(wide, wide.dtype.type(1000))
        return times(whole, source, what, first_row=first_row) + (rest >= 500)
    times(wide * np.float64(US_PER_UNIT[unit]), source, what, 1.0, first_row)  # that they fit
    return wide.astype(np.int64) * round(US_PER_UNIT[unit])


def check_span(
    values: NDArray, source: str, what: str, scale: float = 1, first_row: int = 0
) -> None:
    """Check that times are finite and fit int64 us.

    Args:
        values: (n,) times.
        source: Name of the file for messages.
        what: "event", "image" or the like.
        scale: Microseconds in one unit.
        first_row: Row of the first time in the file.

    Raises:
        InputError: A time is not finite or too large.
    """
    is_float = values.dtype.kind == "f"
    # NaN and infinity fail this comparison too.
    most = MAX_TIME_US / scale if is_float else MAX_TIME_US // scale
    if len(values) and not -most < values.min() <= values.max() < most:
        row = int(np.argmin((values > -most) & (values < most)))
        unit = next(
            (UNIT_NAMES[name] for name, us in US_PER_UNIT.items() if us == scale), UNIT_NAMES["us"]
        )
        shown = f"{values[row]:.16g}" if is_float else str(values[row])
        raise InputError(
            f"{_intro(source)}{what} {first_row + row} has the time {shown}, not finite "
            f"or too large for {unit}; correct the unit or remove it"
        )


def numbers(values: NDArray, source: str, what: str) -> NDArray:
    """Check that an array is a list of integers or floats.

    Args:
        values: The array.
        source: Name of the file for messages.
        what: Name of the array for messages.

    Returns:
        The array.

    Raises:
        InputError: The array has another shape or type.
    """
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        raise InputError(
            f"{_intro(source)}{what} is {values.dtype} of shape {values.shape}; store a list of "
            "numbers"
        )
    return values


def shorten_value(value: Any) -> str:
    """Format a value on one line, cut to 60 characters, for messages."""
    return " ".join(repr(value).split())[:60]


def _intro(source: str) -> str:
    """Return the beginning of a message: the source and a colon, or nothing."""
    return f"{source}: " if source else ""


def as_size(width: Any, height: Any, source: str) -> tuple[int, int]:
    """Check the sides of a sensor.

    Args:
        width: Width in px.
        height: Height in px.
        source: Name of the file or recording for messages.

    Returns:
        (width, height), each from 1 to `MAX_SIDE_PX`.

    Raises:
        InputError: A side is no whole number, or out of this range.
    """
    for name, side in (("width", width), ("height", height)):
        if not isinstance(side, int | np.integer) or isinstance(side, bool):
            raise InputError(
                f"{_intro(source)}{name} is {shorten_value(side)}; give a whole number of pixels"
            )
    if min(width, height) < 1 or max(width, height) > MAX_SIDE_PX:
        raise InputError(
            f"{_intro(source)}the sensor has {width}x{height} pixels, but at most {MAX_SIDE_PX} "
            "of a side, and at least one, can be read; correct its size with size=(width, height) "
            "or --size"
        )
    return int(width), int(height)


def coordinates(
    name: str,
    values: NDArray,
    size: tuple[int, int],
    source: str,
    *,
    first_row: int = 0,
    origin: int = 0,
) -> NDArray[np.uint16]:
    """Check the columns or rows of events.

    Args:
        name: "x" or "y".
        values: (n,) coordinates in px.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.
        first_row: Row of the first event in the file.
        origin: Number of the first column or row of the sensor, 0 or 1.

    Returns:
        (n,) coordinates from 0, plain.

    Raises:
        InputError: A coordinate is no whole number on the sensor; the message names the first.
    """
    values = numbers(values, source, name)
    last = origin + (size[0] if name == "x" else size[1]) - 1
    if values.dtype.kind == "f":
        values = values.astype(np.float32) if values.dtype.itemsize < 4 else values
        good = (values >= origin) & (values <= last) & (values == np.rint(values))
        bad_row = None if good.all() else int(np.argmin(good))
    else:
        # What the type cannot hold is not searched.
        kind, bad_row = np.iinfo(values.dtype), None
        low = kind.min < origin and len(values) and values.min() < origin
        if low or (kind.max > last and len(values) and values.max() > last):
            bad_row = int(np.argmax((values < origin) | (values > last)))
    if bad_row is not None:
        known, value = max(size) < MAX_SIDE_PX, values[bad_row]
        on = f"on the {size[0]}x{size[1]} sensor " if known else ""
        remedy = "remove the event"
        if value > last and known:
            remedy = f"give the sensor's size or {remedy}"
            if values.max() == last + 1 and values.min() > origin:
                remedy = f"count {name} from {origin}, {remedy}"
            elif values.max() < origin + (size[1] if name == "x" else size[0]):
                remedy = f"swap x and y, {remedy}"
        elif np.isfinite(value) and value != np.rint(value):
            remedy = "round x and y to the pixels of the sensor"
        raise InputError(
            f"{_intro(source)}event {first_row + bad_row} has {name} = {value:.12g}; "
            f"{on}{name} is a whole number from {origin} to {last}, so {remedy}"
        )
    return as_plain(values - origin if origin else values, np.uint16)


def polarities(p: NDArray, source: str, first_row: int = 0) -> NDArray[np.bool_]:
    """Check polarities: bool, 0/1 or -1/1 of any type.

    Args:
        p: (n,) polarities.
        source: Name of the file for messages.
        first_row: Row of the first event in the file.

    Returns:
        (n,) plain bool, True is ON.

    Raises:
        InputError: There is another value; the message names the first.
    """
    if p.dtype.kind == "b" and p.ndim == 1:
        p = as_plain(p)
        # A view of other bytes as bool may hold some that are neither.
        return p if not len(p) or p.view(np.uint8).max() <= 1 else p.view(np.uint8) != 0
    p = numbers(p, source, "p")
    if p.dtype == np.uint8 and (not len(p) or p.max() <= 1):
        return as_plain(p).view(np.bool_)
    on, off, negative = p == 1, p == 0, p == -1
    good = on | off | negative
    if not good.all():
        row = int(np.argmin(good))
        remedy = "p > 0 if these are ON, or p == 2 of 1 and 2"
        if p[row] == 255 and on.any():
            remedy = "p == 1, if 255 is -1 without its sign"
        raise InputError(
            f"{_intro(source)}event {first_row + row} has the polarity {p[row]:.12g}; it must be 1 "
            f"for ON and 0 or -1 for OFF; give {remedy}"
        )
    if off.any() and negative.any():
        raise InputError(
            f"{_intro(source)}polarities 0 and -1 both occur; use 0/1 or -1/1 throughout, 1 being "
            "ON"
        )
    return on


def check_lengths(t: Any, x: Any, y: Any, p: Any, source: str) -> None:
    """Check that the four columns of events are equally long.

    Args:
        t: Times.
        x: Columns.
        y: Rows.
        p: Polarities.
        source: Name of the file for messages.

    Raises:
        InputError: The lengths differ.
    """
    if not len(t) == len(x) == len(y) == len(p):
        raise InputError(
            f"{_intro(source)}t, x, y and p have {len(t)}, {len(x)}, {len(y)} and {len(p)} values; "
            "they must be equally long"
        )


def first_decrease(t: NDArray, strict: bool = False) -> int | None:
    """Find the first row whose time is before that of the row above it.

    Args:
        t: (n,) times.
        strict: Whether equal times count, too.

    Returns:
        The row; None if there is none.
    """
    for begin in range(0, max(len(t) - 1, 0), _BLOCK_VALUES):
        # Comparing neighbours is three times faster than np.diff, which writes differences.
        part = t[begin : begin + _BLOCK_VALUES + 1]
        bad = part[1:] <= part[:-1] if strict else part[1:] < part[:-1]
        if bad.any():
            return begin + int(np.argmax(bad)) + 1
    return None


def as_images(frames: Any, what: str = "frames") -> tuple[NDArray, NDArray[np.uint8] | None]:
    """Check the images of a caller, and convert colours to grey.

    Args:
        frames: (n, H, W) or (n, H, W, 3) images, red first: uint8, uint16 or floats in [0, 1].
        what: Name of the argument for messages.

    Returns:
        Grey images (n, H, W), and the colours (n, H, W, 3) uint8; None if there are none, or all of
        them are grey.

    Raises:
        InputError: Types, shapes or values are not valid.
    """
    images = as_array(frames, what)
    shape = images.shape
    if images.ndim == 4 and shape[3] == 1:
        images = images[..., 0]
    check_image_kind(images.dtype, what)
    if images.ndim not in (3, 4) or (images.ndim == 4 and shape[3] != 3):
        remedy = "give (n, H, W) or (n, H, W, 3)"
        if images.ndim == 2:
            remedy += f": {what}[None] for a single image"
        elif images.ndim == 4 and shape[1] == 3:
            remedy += f": {what}.transpose(0, 2, 3, 1) if channels come first"
        elif images.ndim == 4 and shape[1] == 1:
            remedy += f": {what}[:, 0] if channels come first"
        elif images.ndim == 4 and shape[3] == 4:
            remedy += f": {what}[..., :3] leaves out transparency"
        raise InputError(f"{what} have the shape {shape}; {remedy}")
    check_image_values(images, what)
    if images.ndim == 3:
        return plain_images(images), None
    differ = any((one != one[..., :1]).any() for one in images)
    grey = np.stack([to_grey(one) for one in images]) if len(images) else images[..., 0]
    return plain_images(grey), np.stack([_in_8_bits(one) for one in images]) if differ else None


def scale_levels(frames: Any, white: Any, what: str = "frames") -> NDArray:
    """Scale images whose white is not the largest number of their type.

    Args:
        frames: (n, ...) images of any integers, or floats.
        white: Level that is white; black is 0.
        what: Name of the argument for messages.

    Returns:
        Of integers uint16, 65535 white; of floats those in [0, 1].

    Raises:
        InputError: White is no positive number, or a level is negative or beyond white.
    """
    images = as_array(frames, what)
    is_number = isinstance(white, int | float | np.number) and not isinstance(white, bool)
    if not is_number or not 0 < white < np.inf:
        raise InputError(f"white is {shorten_value(white)}; give the level that is white, above 0")
    least, most = (images.min(), images.max()) if images.size else (0, 0)
    if not (least >= 0 and most <= white):  # NaN fails it too
        raise InputError(
            f"{what} hold levels from {least} to {most}, but white = {white}; give their white, "
            "4095 for 12 bits"
        )
    if images.dtype.kind == "f":
        return images / images.dtype.type(white)
    return np.rint(images * np.float32(MAX_LEVEL / white)).astype(np.uint16)


def doubt_levels(images: NDArray) -> str | None:
    """Describe the sign that images of uint16 hold fewer bits, and the remedy; None without one.

    Args:
        images: (n, height, width) images, of which at most `_JUDGED_IMAGES` are looked at.
    """
    if images.dtype != np.uint16 or not images.size:
        return None
    some = np.unique(np.linspace(0, len(images) - 1, _JUDGED_IMAGES).astype(int))
    most = max(int(images[row].max()) for row in some)
    bits = next((bits for bits in _USUAL_BITS if most < 1 << bits), None)
    if not most or bits is None:
        return None
    white = (1 << bits) - 1
    return (
        f"frames are uint16, whose white is {MAX_LEVEL}, but no level exceeds {most}, as of "
        f"{bits} bits; if white is {white}, give white={white} to Recording.from_arrays, or store "
        f"frames * {MAX_LEVEL / white:g} as uint16"
    )


def to_grey(image: NDArray) -> NDArray:
    """Convert an image to grey of its own type, rounded as Pillow does.

    Args:
        image: (H, W), which stays as it is, or (H, W, 3), red first.

    Returns:
        (H, W) luma of ITU-R 601.
    """
    if image.ndim == 2:
        return image
    if image.dtype.kind == "f":
        return image @ LUMA_WEIGHTS.astype(image.dtype)
    parts = (image[..., k].astype(np.uint32) * np.uint32(_LUMA_WEIGHTS_2_16[k]) for k in range(3))
    return ((sum(parts) + np.uint32(1 << 15)) >> np.uint32(16)).astype(
        image.dtype.newbyteorder("=")
    )


def _in_8_bits(image: NDArray) -> NDArray[np.uint8]:
    if image.dtype.kind == "f":
        return np.rint(image * 255).astype(np.uint8)
    if image.dtype.itemsize == 1:
        return image
    return ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)


def plain_images(images: NDArray) -> NDArray:
    """Return images as plain arrays, see `as_plain`; floats become those of 32 or 64 bits."""
    if images.dtype.kind == "f" and images.dtype.itemsize not in (4, 8):
        return as_plain(images, np.float32 if images.dtype.itemsize < 4 else np.float64)
    return as_plain(images)


def check_image_kind(dtype: np.dtype, what: str) -> None:
    """Check the type of images: uint8, uint16 or floats.

    Args:
        dtype: The type.
        what: Name of the images for messages.

    Raises:
        InputError: The type is another.
    """
    if dtype.kind != "f" and (dtype.kind != "u" or dtype.itemsize > 2):
        raise InputError(
            f"{what} are {dtype}; store uint8, uint16 or floats in [0, 1], such as "
            f"{what}.astype('uint8') of levels from 0 to 255"
        )


def check_image_values(images: Any, what: str) -> None:
    """Check that float images hold values in [0, 1].

    Args:
        images: (n, ...) images.
        what: Name of the images for messages.

    Raises:
        InputError: A value is NaN or outside [0, 1].
    """
    if images.dtype.kind != "f":
        return
    for row in range(len(images)):
        image = np.asarray(images[row : row + 1])
        if image.size and not (image.min() >= 0 and image.max() <= 1):  # NaN fails it too
            raise InputError(
                f"{what}: frame {row} holds NaN or values outside [0, 1]; scale float frames to "
                "[0, 1], dividing by 255 if these are levels of 8 bits, and remove broken ones"
            )
