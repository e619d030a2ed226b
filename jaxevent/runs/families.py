"""The families of estimators, each loaded when a configuration first asks for it."""

from typing import Any

from jaxevent.errors import InputError
from jaxevent.estimator import Estimator, imported
from jaxevent.parameters import suggest_name
from jaxevent.runs.family import Family, Protocol

HOMES = {
    "reconstruction": "jaxevent.runs.reconstruction:FAMILY",
    "blob": "jaxevent.runs.blob:FAMILY",
    "egomotion": "jaxevent.runs.egomotion:FAMILY",
}


def family_of(method: Estimator) -> Family:
    """The family of an estimator; raises `InputError` for one that nobody knows."""
    if method.family not in HOMES:
        raise InputError(
            f"the method {method.name!r} is of the family {method.family!r}; "
            f"{suggest_name(method.family, HOMES)}"
        )
    return find_family(method.family)


def find_family(name: str) -> Family:
    return imported(HOMES[name], Family, "family")


def find_protocol(name: Any) -> tuple[Protocol, str]:
    """The protocol of that name and its family's; raises `InputError` naming the nearest."""
    known = {protocol: family for family in HOMES for protocol in find_family(family).protocols}
    if name not in known:
        raise InputError(f"there is no protocol {name!r}; {suggest_name(str(name), known)}")
    return find_family(known[name]).protocols[name], known[name]
