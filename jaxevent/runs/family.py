"""The interface between a family of estimators and evaluations or fits.

A family offers `Protocol`s, by which `evaluate` scores methods, and a `Goal` for each method, to
which `fit` fits it. `family_of` and `find_protocol` find them.
"""

import abc
import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.estimator import Estimator, import_object
from jaxevent.parameters import Parameters, check_choice, suggest_name
from jaxevent.processes import partition_batches
from jaxevent.recording import Recording
from jaxevent.runs.config import Check
from jaxevent.show.tables import Row
from jaxevent.tuning import Batches, Loss

SPLIT_NAMES = ("fit", "validation", "test")
Sources = Mapping[str, Sequence[tuple[str, Recording]]]  # (as given, recording) by split
Settings = Mapping[str, Any]  # of a protocol and a method, by name; see `Protocol.settings`
Shares = tuple[int, ...] | None  # of fit, validation, test; None: they have their own recordings


class Source(abc.ABC):
    """Results that something else made, scored by a protocol beside estimators."""

    name: ClassVar[str]

    @classmethod
    @abc.abstractmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "Source":
        """Make a source from the settings of a [[method]].

        Args:
            table: The settings.
            folder: Folder of the configuration, to which paths are relative.

        Returns:
            The source.

        Raises:
            InputError: A setting cannot be used; the message names it.
        """

    @abc.abstractmethod
    def values(self) -> dict[str, Any]:
        """Return the settings, as a row shows them."""

    def row(self, recording: str) -> dict[str, Any] | None:
        """Return known results of a recording by its name; None if they have to be scored."""
        return None

    @abc.abstractmethod
    def files(self, recording: str) -> Sequence[Path]:
        """Return the files that are read for a recording."""


class Protocol(abc.ABC):
    """A way of comparing results with the ground truth of a recording.

    `settings` may stand beside `protocol = NAME` in a configuration, `own` in a [[method]].
    """

    settings: ClassVar[Mapping[str, Check]] = {}
    own: ClassVar[Mapping[str, Check]] = {}
    sources: ClassVar[Mapping[str, type[Source]]] = {}

    def check(self, options: Settings) -> None:  # noqa: B027
        """Raise `InputError` for settings that are missing or not possible together."""

    def available(self, options: Settings) -> dict[str, Any]:
        """Return the settings without optional ones whose extra is not installed."""
        return dict(options)

    def check_method(  # noqa: B027
        self, method: Estimator, options: Settings
    ) -> None:
        """Raise `InputError` if the settings ask for something that the method cannot do."""

    def label(self, options: Settings) -> str:
        """Return the ending of a method's label, from settings of the protocol and the method."""
        return ""

    def files(self, path: Path, options: Settings) -> list[Path]:
        """Return further files that a row of the recording depends on."""
        return []

    @abc.abstractmethod
    def score(
        self,
        recording: Recording,
        method: Any,
        params: Any,
        options: Settings,
        progress: bool | None = None,
    ) -> dict[str, Any]:
        """Score a method on a recording.

        Args:
            recording: The recording, with its ground truth.
            method: An `Estimator`, or a `Source`.
            params: Parameters of the estimator; None for a source.
            options: Settings of the protocol and the method's own.
            progress: Whether to show a bar; None shows it in a terminal or notebook.

        Returns:
            A row of results without names. `samples` in it are images that the report shows.

        Raises:
            InputError: The recording or the method cannot be scored.
        """


@dataclasses.dataclass(frozen=True)
class FitData:
    """Recordings of a fit, and how they are cut into parts.

    Attributes:
        sources: Recordings by split, each with its name.
        split: Shares of fit, validation and test; None if recordings are given for each.
        window: Length of a window, s; None for the default.
    """

    sources: Sources
    split: Shares = None
    window: float | int | None = None

    def __iter__(self) -> Iterator[tuple[int, str, Recording]]:
        """Yield the place in `SPLIT_NAMES`, the name and the recording of each source."""
        for place, split in enumerate(SPLIT_NAMES):
            for given, recording in self.sources[split]:
                yield place, given, recording


class LastBatches:
    """Batches as a function of parameters, made again only if `key(params)` changes.

    `make(params)` gives the batches to fit to and to validate on.
    """

    def __init__(self, key: Callable[[Any], Any], make: Callable[[Any], Batches]):
        self._key, self._make = key, make
        self._last: tuple[Any, Batches] | None = None

    def __call__(self, params: Any) -> Batches:
        fixed = self._key(params)
        if self._last is None or self._last[0] != fixed:
            self._last = None  # so that two are never held at once
            self._last = fixed, self._make(params)
        return self._last[1]


def batches_by_split(parts: Sequence[Any], batches: Sequence[Any]) -> Batches:
    """Divide batches into those to fit to and those to validate on.

    Args:
        parts: Parts of recordings; `split` is 0 for the fit and 1 for validation.
        batches: Batch of each part.

    Returns:
        Batches to fit to, and batches to validate on; those of other processes are marked.
    """
    pairs = list(zip(parts, batches, strict=True))
    fit, validation = (
        partition_batches([b for part, b in pairs if part.split == s]) for s in (0, 1)
    )
    return fit, validation


class Goal(abc.ABC):
    """Data and loss of the fit of one method, and the scores of the result."""

    loss: Loss  # of `optimise`; equal goals have losses that are equal and hash alike
    # Whether derivatives are computed forwards; None decides by the number of parameters.
    forward: bool | None = None
    measure: str  # column of a row that states the gain of a fit; smaller is better
    part_name: str = "window"  # word for the parts that the loss averages over

    def files(self, recording: Path) -> list[Path]:
        """Return the files that are read besides the recording."""
        return []

    def calibrate(self, data: FitData, params: Any, names: Sequence[str]) -> Any:
        """Return the start of a fit, calibrated by the recordings to fit.

        Args:
            data: The recordings.
            params: Parameters.
            names: Names of the numbers.

        Returns:
            The parameters.
        """
        return params

    @abc.abstractmethod
    def problem(self, data: FitData) -> Callable[[Any], Batches]:
        """Make the batches to fit to and to validate on, as functions of parameters.

        Args:
            data: The recordings.

        Returns:
            A function from parameters to batches, as `tuning.optimise` takes it.
        """

    @abc.abstractmethod
    def score(self, data: FitData, params: Any, progress: bool | None) -> Iterator[dict[str, Any]]:
        """Yield rows of every recording and split, with the keys recording and split.

        Args:
            data: The recordings.
            params: Parameters to score.
            progress: Whether to show a bar; None shows it in a terminal or notebook.

        Returns:
            Rows, one at a time.
        """

    @abc.abstractmethod
    def table(self, rows: Sequence[Row]) -> str:
        """Format rows, which now have the key method too, as a Markdown table."""


class Family(abc.ABC):
    """A family of estimators, as configurations use it."""

    protocols: Mapping[str, Protocol]
    fit_settings: Mapping[str, Check]  # of a fit's configuration
    own: Collection[str]  # those of them that a [[method]] may have for itself

    @abc.abstractmethod
    def goal(self, method: Any, params: Parameters, settings: Mapping[str, Any]) -> Goal:
        """Make the goal of a method.

        Args:
            method: The estimator.
            params: Parameters that the fit starts from.
            settings: Checked settings; the method's own win over those of the file.

        Returns:
            The goal.
        """


MODULE_OF_FAMILY = {
    "reconstruction": "jaxevent.runs.reconstruction:FAMILY",
    "blob": "jaxevent.runs.blob:FAMILY",
    "egomotion": "jaxevent.runs.egomotion:FAMILY",
}


def family_of(method: Estimator) -> Family:
    """Return the family of an estimator; raise `InputError` for an unknown one."""
    if method.family not in MODULE_OF_FAMILY:
        raise InputError(
            f"the method {method.name!r} is of the family {method.family!r}; "
            f"{suggest_name(method.family, MODULE_OF_FAMILY)}"
        )
    return find_family(method.family)


def find_family(name: str) -> Family:
    return import_object(MODULE_OF_FAMILY[name], Family, "family")


def find_protocol(name: Any) -> tuple[Protocol, str]:
    """Return the protocol of a name and its family's name.

    Raise `InputError` for an unknown one.
    """
    known = {
        protocol: family
        for family in MODULE_OF_FAMILY
        for protocol in find_family(family).protocols
    }
    check_choice(name, "protocol", known)
    return find_family(known[name]).protocols[name], known[name]


def interleave(shares: Sequence[int], n_images: int) -> NDArray[np.int64]:
    """Assign each of `n_images` images to a split, with `shares` in a fixed pattern.

    [2, 1, 1] repeats fit, validation, fit, test.

    Args:
        shares: Shares of fit, validation and test.
        n_images: Number of images.

    Returns:
        (count,) index in `SPLIT_NAMES`.
    """

    def spread(share: int, of: int) -> NDArray[np.bool_]:
        steps = np.ceil(np.arange(of + 1) * share / max(of, 1))
        return np.diff(steps) > 0

    pattern = np.zeros(sum(shares), np.int64)
    others = np.flatnonzero(~spread(shares[0], sum(shares)))
    pattern[others] = np.where(spread(shares[1], len(others)), 1, 2)
    return np.resize(pattern, n_images)


def windows(
    start_us: int,
    stop_us: int,
    window_s: float | int | None,
    shares: Sequence[int] | None,
    unsplit_index: int,
) -> list[tuple[int, int, int]]:
    """Cut the time from `start_us` to `stop_us` into windows.

    Args:
        start_us: Start of the first window, us.
        stop_us: End of the last window, us.
        window_s: Length of a window, s; by default an eighth of the time if `shares` is given, else
            all.
        shares: Shares of fit, validation and test; None assigns all windows to `unsplit_index`.
        unsplit_index: Index in `SPLIT_NAMES` of all windows without `shares`.

    Returns:
        Start (us), end (us) and index in `SPLIT_NAMES` of each window.
    """
    length = stop_us - start_us
    if window_s is not None:
        length = round(window_s * 1e6)
    elif shares is not None:
        length = -(-length // 8)
    begins = np.arange(start_us, stop_us, max(length, 1))
    whose = (
        np.full(len(begins), unsplit_index) if shares is None else interleave(shares, len(begins))
    )
    return [
        (b, min(b + length, stop_us), s)
        for b, s in zip(begins.tolist(), whose.tolist(), strict=True)
    ]
