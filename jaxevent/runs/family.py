"""What evaluations and fits ask of a family of estimators.

A family offers `Protocol`s, by which `evaluate` scores methods, and a `Goal` for each method, to
which `fit` fits it. `jaxevent.runs.families` names the families.
"""

import abc
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from jaxevent.devices import partition_batches
from jaxevent.estimator import Estimator
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording
from jaxevent.runs.config import Check
from jaxevent.tuning import Batches, Loss

Sources = Mapping[str, Sequence[tuple[str, Recording]]]  # (as given, recording) by split
Shares = tuple[int, ...] | None  # of fit, validation, test; None: they have their own recordings


class Source(abc.ABC):
    """What a protocol scores beside estimators: results that something else made."""

    name: ClassVar[str]

    @classmethod
    @abc.abstractmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "Source":
        """From the settings of a [[method]]; raises `InputError` naming a bad one."""

    @abc.abstractmethod
    def values(self) -> dict[str, Any]:
        """The settings, as a row shows them."""

    def row(self, recording: str) -> dict[str, Any] | None:
        """The results of the recording of that name, where they are known; None: to be scored."""
        return None

    @abc.abstractmethod
    def files(self, recording: str) -> Sequence[Path]:
        """What is read for the recording of that name."""


class Protocol(abc.ABC):
    """How results are compared with what is known of a recording.

    `settings` may stand beside `protocol = NAME` in a configuration, `own` in a [[method]].
    """

    settings: ClassVar[Mapping[str, Check]] = {}
    own: ClassVar[Mapping[str, Check]] = {}
    sources: ClassVar[Mapping[str, type[Source]]] = {}

    def check(self, options: Mapping[str, Any]) -> None:  # noqa: B027
        """Raise `InputError` for settings that are missing or not possible together."""

    def available(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """The settings without what needs an extra that is not installed, if it is optional."""
        return dict(options)

    def check_method(  # noqa: B027
        self, method: Estimator, options: Mapping[str, Any]
    ) -> None:
        """Raise `InputError` if the settings ask for what the method cannot do."""

    def label(self, options: Mapping[str, Any]) -> str:
        """What the label of a method ends in, of settings of the protocol and of its own."""
        return ""

    def files(self, path: Path, options: Mapping[str, Any]) -> list[Path]:
        """Further files that a row of the recording depends on."""
        return []

    @abc.abstractmethod
    def score(
        self,
        recording: Recording,
        method: Any,
        params: Any,
        options: Mapping[str, Any],
        progress: bool | None = None,
    ) -> dict[str, Any]:
        """A row of results without names; raises `InputError` where it cannot be made.

        `method` is an `Estimator` with its `params`, or a `Source` and None. `options` are the
        settings of the protocol and the method's own. A `sample` in the row is the picture that the
        report shows.
        """


class LastBatches:
    """Batches as a function of parameters, made again only where `key(params)` is another.

    `make(params)` gives those to fit to and those to validate on.
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


def share_out(parts: Sequence[Any], batches: Sequence[Any]) -> Batches:
    """The batches of parts by their `split`, those of other processes left to them."""
    pairs = list(zip(parts, batches, strict=True))
    fit, validation = (
        partition_batches([b for part, b in pairs if part.split == s]) for s in (0, 1)
    )
    return fit, validation


class Goal(abc.ABC):
    """What one method of a configuration is fitted to, and how what comes of it is scored."""

    loss: Loss  # of `optimise`; equal goals have losses that are equal and hash alike
    forward: bool | None = None  # derivatives forwards or in reverse; None: see `tuning.FORWARD`
    measure: str  # of a row, what the gain of a fit is told in; the smaller the better
    part: str = "window"  # of which parts the loss is a mean; see `jaxevent.confidence`

    def files(self, recording: Path) -> list[Path]:
        """What is read besides the recording."""
        return []

    @abc.abstractmethod
    def problem(
        self, sources: Sources, split: Shares, window: float | int | None
    ) -> Callable[[Any], Batches]:
        """The batches to fit to and to validate on, as functions of parameters."""

    @abc.abstractmethod
    def score(
        self,
        sources: Sources,
        split: Shares,
        window: float | int | None,
        params: Any,
        progress: bool | None,
    ) -> Iterator[dict[str, Any]]:
        """Rows of every recording and split: they have the keys recording and split."""

    @abc.abstractmethod
    def table(self, rows: Sequence[Mapping[str, Any]]) -> str:
        """Rows, which now have the key method too, as a Markdown table."""


class Family(abc.ABC):
    """A family of estimators, as configurations know it."""

    protocols: Mapping[str, Protocol]
    fit_settings: Mapping[str, Check]  # of a fit's configuration
    own: Collection[str]  # those of them that a [[method]] may have for itself

    @abc.abstractmethod
    def goal(self, method: Any, params: Parameters, settings: Mapping[str, Any]) -> Goal:
        """From checked settings, the method's own before those of the file."""
