"""Methods and metrics of a user's own: "package.module:object" in TOML, objects in Python.

A metric is a function `metric(estimate, truth)` of two arrays that returns a number:

| family | arrays | called for |
|---|---|---|
| reconstruction | intensity (H, W), 0 black and 1 white | every image |
| blob | positions (T, targets, 2) in px, NaN where unknown | every recording |
| egomotion | components (T, d) of the model, at times that are not lost | every recording |

Where a recording holds the camera's response or gains, intensity is linear, as that of
`Recording.linear_frames`; else it is the frames' grey value.

An attribute says which values are good, so that reports mark the best: `metric.higher_is_better =
True`, or False.

A method is an `Estimator`, or a function `method(recording, times)` that returns an estimate at
`times` (T,), int64 us: the mean, or a tuple (mean, covariance) with the shapes of
`jaxevent.estimator.Estimate`. Of blobs the mean may be positions (T, targets, 2) alone; NaN where
a target is not tracked, or where the motion is lost. Times are on the events' clock. Only those of
hidden frames are their stamps, to which the function adds the offset of the clocks itself.
"""

import dataclasses
import hashlib
import importlib
import sys
import traceback
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent import methods
from jaxevent.arrays import shorten_value
from jaxevent.display import describe_type
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, Estimator, import_object
from jaxevent.parameters import check_choice
from jaxevent.recording import Recording

# Keys of rows that are no measures: no metric may have their names.
RESERVED_NAMES = (
    "recording", "method", "params", "error", "skipped", "split", "warning", "per_frame",
    "per_time", "own_metrics", "regions", "moving", "clip", "normalise", "gap", "model", "frames",
    "missing", "events", "times", "windows", "seconds", "t", "samples",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Metric:
    """A user's metric and its name in results."""

    name: str
    function: Callable[[Any, Any], Any]  # function (estimate, truth) that returns a number

    @property
    def higher_is_better(self) -> bool | None:
        """True if higher is better, as an attribute of the function says; None without one."""
        given = getattr(self.function, "higher_is_better", None)
        return None if given is None else bool(given)

    def __call__(self, estimate: NDArray, truth: NDArray, recording: str) -> float:
        """Compute the metric.

        The function gets copies, so that it cannot change the input of other metrics.

        Args:
            estimate: The estimate.
            truth: The truth that it is compared with.
            recording: Name of the recording, for messages.

        Returns:
            A finite number.

        Raises:
            InputError: The function fails, or gives no finite number.
        """
        where = f"{recording}: the metric {self.name!r}"
        try:
            value = self.function(np.array(estimate), np.array(truth))
        except Exception as error:  # whatever the user's code raises
            raise InputError(describe_failure(where, error, self.function)) from error
        try:
            number = float(value) if np.size(value) == 1 else None
        except (TypeError, ValueError):
            number = None
        if number is None:
            raise InputError(f"{where} returned {_describe_value(value)}; return one number")
        if not np.isfinite(number):
            raise InputError(
                f"{where} returned {number}, which has no mean; return a finite number"
            )
        return number


def find_metrics(given: Iterable[Any], known: Collection[str]) -> list[Metric]:
    """Find the user's metrics among those given.

    Args:
        given: Metrics: names, "package.module:function", functions, or `Metric`s.
        known: Names of the protocol's own metrics.

    Returns:
        The user's metrics.

    Raises:
        InputError: A name is unknown, an object is not callable, or a name is given twice.
    """
    found: dict[str, Metric] = {}
    for one in given:
        if isinstance(one, str) and ":" not in one:
            check_choice(one, "metric", known)
            continue
        metric = one if isinstance(one, Metric) else _metric(one)
        if metric.name in known or metric.name in RESERVED_NAMES:
            raise InputError(
                f"a metric of your own is called {metric.name!r}, as results call something else; "
                "rename it"
            )
        if metric.name in found:
            raise InputError(f"two metrics are called {metric.name!r}; rename one")
        found[metric.name] = metric
    return list(found.values())


def _metric(given: Any) -> Metric:
    function = import_object(given, object, "metric") if isinstance(given, str) else given
    return named_metric(given, function)


def named_metric(given: Any, function: Any, name: str | None = None) -> Metric:
    """Make a metric from a function.

    Args:
        given: The metric as the user gave it, for messages.
        function: A function of an estimate and the truth.
        name: Name of the metric; None takes the function's.

    Returns:
        The metric.

    Raises:
        InputError: The function cannot be called or has no name.
    """
    if not callable(function) or isinstance(function, type):
        raise InputError(
            f"the metric {given!r} is {describe_type(function)}, which cannot be called; give a "
            "function of an estimate and the truth"
        )
    name = name or getattr(function, "__name__", None) or getattr(function, "name", None)
    if not isinstance(name, str) or name == "<lambda>":
        raise InputError(
            f"the metric {_describe_value(given)} has no name; give metrics as a mapping from "
            'names, as {"my_metric": function}'
        )
    return Metric(name, function)


def own_names(metrics: Iterable[Metric]) -> dict[str, dict[str, bool | None]]:
    """Return the entry of a row that names the user's metrics; empty without any.

    Args:
        metrics: The user's metrics.

    Returns:
        Under "own_metrics", for each name whether higher is better; None where it is not known.
    """
    names = {metric.name: metric.higher_is_better for metric in metrics}
    return {"own_metrics": names} if names else {}


class MethodFunction(NamedTuple):
    """A method that is a function: `estimate = function(recording, times)`."""

    name: str
    function: Callable[[Recording, NDArray[np.int64]], Any]

    def estimate(
        self,
        recording: Recording,
        times: NDArray[np.int64],
        shapes: Sequence[tuple[int, ...]],
        *,
        intensity: bool = False,
    ) -> Estimate:
        """Call the function and check its result.

        Args:
            recording: The recording that the method is given.
            times: (T,) int64, us.
            shapes: Allowed shapes of the mean without the axis of times; -1 is any number.
            intensity: Whether the mean is intensity, which is 0 at black and 1 at white: grey
                levels are refused, and so is what has no finite number.

        Returns:
            Mean and covariance; the latter is None if the function returns none.

        Raises:
            InputError: The function raised an error, or returned no array of an allowed shape,
                or no intensity where this is asked for.
        """
        where = f"{recording.name}: the method {self.name!r}"
        try:
            found = self.function(recording, times)
        except Exception as error:  # whatever the user's code raises
            raise InputError(describe_failure(where, error, self.function)) from error
        parts = [*found] if isinstance(found, tuple | Estimate) else [found]
        try:
            arrays = [None if part is None else np.asarray(part) for part in parts[:2]]
        except (TypeError, ValueError):
            arrays = []
        mean = arrays[0] if arrays else None
        wanted = " or ".join(_axes(shape) for shape in shapes)
        if (
            mean is None
            or mean.dtype.kind not in "iufb"
            or not _is_possible_shape(mean.shape, times, shapes)
        ):
            raise InputError(
                f"{where} returned {_describe_value(parts[0])}; return an array {wanted}"
            )
        if intensity and mean.dtype.kind in "iu":
            raise InputError(
                f"{where} returned grey levels as {mean.dtype}; return intensity as floats, 0 at "
                "black and 1 at white, for example levels / 255"
            )
        if intensity and not np.isfinite(mean).any():
            raise InputError(f"{where} returned no finite number; return images of intensity")
        covariance = arrays[1] if len(arrays) > 1 else None
        mean = mean.astype(np.float64) if mean.dtype.kind != "f" else mean
        return Estimate(mean, covariance, np.isfinite(mean))


def _is_possible_shape(
    shape: tuple[int, ...], times: NDArray[np.int64], shapes: Sequence[tuple[int, ...]]
) -> bool:
    return any(
        len(shape) == len(one) + 1
        and shape[0] == len(times)
        and all(b in (-1, a) for a, b in zip(shape[1:], one, strict=True))
        for one in shapes
    )


def _axes(shape: tuple[int, ...]) -> str:
    return f"({', '.join(['times', *('targets' if n < 0 else str(n) for n in shape)])})"


def find_method(given: Any, family: str | None = None) -> Estimator | MethodFunction:
    """Find a method by name, "package.module:object", or the object itself.

    Args:
        given: Name, path or object.
        family: Family that it must belong to; None allows all.

    Returns:
        The estimator or function.

    Raises:
        InputError: The name is unknown, the method is of another family, or is no method.
    """
    if isinstance(given, str):
        if ":" not in given:
            return methods.find(given, family)
        found = import_object(given, object, "method")
    else:
        found = given
    if isinstance(found, MethodFunction):
        return found
    if isinstance(found, Estimator):
        methods.check_family(found, family, found.name)
        return found
    what = repr(given) if isinstance(given, str) else _describe_value(given)
    if isinstance(found, type):
        raise InputError(f"the method {what} is a class; give an object of it")
    if not callable(found):
        raise InputError(
            f"the method {what} is {describe_type(found)}, not an Estimator; give a name, an "
            "Estimator or a function of a recording and times"
        )
    return MethodFunction(getattr(found, "__name__", type(found).__name__), found)


def import_path(thing: Any) -> str | None:
    """Return the text by which other processes find an object: a method's name, or "module:object".

    None if they cannot: it was made in a notebook or inside a function, or is in no module.
    """
    if isinstance(thing, Estimator):
        if thing.name in methods.names() and methods.find(thing.name) is thing:
            return thing.name
        places = {type(thing).__module__, thing.Params.__module__}
    else:
        places = {getattr(thing, "__module__", None)}
    for place in sorted(filter(None, places)):
        module = sys.modules.get(place)
        if module is None or place == "__main__" or not getattr(module, "__file__", None):
            continue
        for name, value in vars(module).items():
            if value is thing:
                return f"{place}:{name}"
    return None


def module_hash(path: str) -> str | None:
    """Hash the file of the module in "module:object"; None without a file."""
    file = getattr(importlib.import_module(path.partition(":")[0]), "__file__", None)
    if file is None or not Path(file).is_file():
        return None
    return hashlib.blake2b(Path(file).read_bytes(), digest_size=16).hexdigest()


def describe_failure(where: str, error: BaseException, function: Callable[..., Any]) -> str:
    """Describe an exception of a user's function, with the last line in the function's own file.

    Args:
        where: Recording and function, for the beginning of the sentence.
        error: The exception.
        function: The user's function.

    Returns:
        A sentence.
    """
    lines = traceback.extract_tb(error.__traceback__)[1:]
    file = getattr(getattr(function, "__code__", None), "co_filename", None)
    own = [line for line in lines if line.filename == file] or lines
    place = f" at line {own[-1].lineno} of {own[-1].filename}" if own else ""
    return f"{where} raised {describe_error(error)}{place}; correct it"


def describe_error(error: BaseException) -> str:
    """Describe an exception: its type, and its message in one line."""
    reason = " ".join(str(error).split())
    return f"{type(error).__name__}{f' ({reason})' if reason else ''}"


def _describe_value(thing: Any) -> str:
    shape = getattr(thing, "shape", None)
    if shape is not None and shape != ():
        return f"{getattr(thing, 'dtype', type(thing).__name__)} of shape {tuple(shape)}"
    return shorten_value(thing)
