"""The errors that are the user's to mend: bad input, said in a sentence."""

import importlib
from types import ModuleType


class InputError(ValueError):
    """A file, setting or argument cannot be used.

    The message is one sentence that names the file, the place in it and the remedy; the command
    line prints it and exits with status 2.
    """


class MissingExtra(InputError):
    """A package is not installed that an extra of jaxevent installs.

    Nothing is wrong with what was given: evaluations leave out what needs the package.
    """


def require(module: str, extra: str) -> ModuleType:
    """Import `module`, or raise `MissingExtra` naming the extra of jaxevent that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtra(
            f"this needs the package {module.partition('.')[0]!r}: pip install 'jaxevent[{extra}]'"
        ) from error
