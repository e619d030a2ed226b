"""Registry of every estimator by name, loaded at its first use.

To add one: a line here, or from outside "package.module:object" wherever a name is expected.
"""

import functools
from collections.abc import Iterator, Mapping

from jaxevent.errors import InputError
from jaxevent.estimator import Estimator, import_object
from jaxevent.parameters import suggest_name

METHOD_HOMES = {
    "reconstruction": {
        "akf": "jaxevent.reconstruction.kalman:akf",
        "aks": "jaxevent.reconstruction.smoother:aks",
        "cf": "jaxevent.reconstruction.complementary:cf",
        "cf-augmented": "jaxevent.reconstruction.complementary:cf_augmented",
        "high-pass": "jaxevent.reconstruction.complementary:high_pass",
        "events-only": "jaxevent.reconstruction.events_only:events_only",
        "edi": "jaxevent.reconstruction.direct:edi",
        "augmented": "jaxevent.reconstruction.direct:augmented",
        "flow": "jaxevent.reconstruction.optical_flow:flow",
        "blend": "jaxevent.reconstruction.direct:blend",
        "last-frame": "jaxevent.reconstruction.direct:last_frame",
        "mc": "jaxevent.reconstruction.compensated:mc",
    },
    "blob": {
        "moment": "jaxevent.blob:moment",
        "chi2": "jaxevent.blob:chi2",
        "chi2_split": "jaxevent.blob:chi2_split",
        "constant_velocity": "jaxevent.blob:constant_velocity",
        "moving_moments": "jaxevent.blob:moving_moments",
    },
    "egomotion": {
        "voting": "jaxevent.egomotion.particle_filter.estimator:voting",
        "batch": "jaxevent.egomotion.bundle.sequence:batch",
        "contrast": "jaxevent.egomotion.baselines.contrast:contrast",
        "planes": "jaxevent.egomotion.baselines.planes:planes",
        "frames": "jaxevent.egomotion.baselines.points:frames",
    },
}


class UnknownMethod(InputError, KeyError):
    """Error for a name that no method has."""

    __str__ = Exception.__str__  # that of KeyError is the message's repr


@functools.cache
def _load(path: str) -> Estimator:
    return import_object(path, Estimator, "method")


def names(family: str | None = None) -> list[str]:
    """Return the names of the estimators of a family, or of all."""
    return [name for key, homes in METHOD_HOMES.items() if family in (None, key) for name in homes]


def find(name: str, family: str | None = None) -> Estimator:
    """Find an estimator by its name, or by "package.module:object".

    Args:
        name: Name of a method, or the place of an `Estimator`.
        family: "reconstruction", "blob" or "egomotion"; None allows all.

    Returns:
        The estimator.

    Raises:
        InputError: The name is unknown, or the method is of another family.
    """
    if ":" in name:
        found = _load(name)
    else:
        known = {one: path for homes in METHOD_HOMES.values() for one, path in homes.items()}
        if name not in known:  # Python's names have an underline for each hyphen
            name = name.replace("_", "-") if name.replace("_", "-") in known else name
        if name not in known:
            raise UnknownMethod(f"there is no method {name!r}; {suggest_name(name, names(family))}")
        found = _load(known[name])
    check_family(found, family, name)
    return found


def check_family(found: Estimator, family: str | None, name: str) -> None:
    """Raise `InputError` for a method of another family than `family`.

    Args:
        found: The estimator.
        family: "reconstruction", "blob" or "egomotion"; None allows all.
        name: Name of the estimator in the message.
    """
    if family is not None and found.family != family:
        raise InputError(
            f"the method {name!r} is of {found.family}, not of {family}; "
            f"{suggest_name(name, names(family))}"
        )


class _Methods(Mapping[str, Estimator]):
    """All estimators by name, each loaded at its first use.

    A name that does not exist raises `UnknownMethod`, a `KeyError` that names the nearest.
    """

    def __getitem__(self, name: str) -> Estimator:
        if name not in names():
            raise UnknownMethod(f"there is no method {name!r}; {suggest_name(str(name), names())}")
        return find(name)

    def __iter__(self) -> Iterator[str]:
        return iter(names())

    def __len__(self) -> int:
        return len(names())

    def __repr__(self) -> str:
        lines = [f"{family}: {', '.join(names(family))}" for family in METHOD_HOMES]
        return "\n".join([f"<{len(self)} methods, each METHODS[name]>", *lines])

    def __reduce__(self) -> str:
        return "METHODS"


METHODS: Mapping[str, Estimator] = _Methods()
