"""Published numbers, shown beside those computed here.

    [[method]]
    name = "published"
    label = "AKF, paper's table 2"
    measures = ["mse", "ssim", "lpips"]

    [method.values]
    boxes_6dof = [0.0026, 0.80, 0.26]
    "trees*1" = [0.0179, 0.82]          # any name that matches; missing numbers are unknown

A row is that of the recording whose name matches, and needs no file. Measures are those that the
tables of an evaluation have columns for, in the units of its rows: `mse` is not times 100.
"""

import dataclasses
import fnmatch
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxevent.errors import InputError
from jaxevent.runs.config import check, check_choice, is_number, is_texts
from jaxevent.runs.family import Source
from jaxevent.show.tables import COLUMNS

MEASURE_NAMES = [place for _, place, _, _ in COLUMNS if "." not in place]


@dataclasses.dataclass(frozen=True)
class PublishedResults(Source):
    """Published numbers by recording; see the text of this module."""

    measures: Sequence[str]
    numbers: Mapping[str, Sequence[float | int]]  # by the recordings' names

    name = "published"

    @classmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "PublishedResults":
        is_table = (lambda value: isinstance(value, dict) and bool(value), "a table of lists")
        check(table, {"measures": (is_texts, 'names, as ["mse", "ssim"]'), "values": is_table})
        for name in ("measures", "values"):
            if name not in table:
                raise InputError(f"{name} is missing; published numbers need measures and values")
        for measure in table["measures"]:
            check_choice(measure, "measure", MEASURE_NAMES)
        for name, numbers in table["values"].items():
            few = isinstance(numbers, list) and len(numbers) <= len(table["measures"])
            if not few or not all(map(is_number, numbers)):
                raise InputError(
                    f"the published values of {name} are {numbers!r}; give a list of at most "
                    f"{len(table['measures'])} numbers, those of {', '.join(table['measures'])}"
                )
        return cls(table["measures"], table["values"])

    def values(self) -> dict[str, Any]:
        """Return the settings."""
        return {"measures": list(self.measures), "values": dict(self.numbers)}

    def files(self, recording: str) -> Sequence[Path]:
        return ()

    def row(self, recording: str) -> dict[str, Any]:
        """Return the numbers of a recording, None for those that are not published."""
        found: Sequence[float | int] = ()
        for name, numbers in self.numbers.items():
            if fnmatch.fnmatchcase(recording, name):
                found = numbers
                break
        told = dict.fromkeys(("mse", "ssim", *self.measures))
        return {**told, **dict(zip(self.measures, found, strict=False))}
