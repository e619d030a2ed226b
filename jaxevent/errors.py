"""The one kind of error that is the user's to mend: bad input, said in a sentence."""

import importlib
from types import ModuleType


class InputError(ValueError):
    """A file, setting or argument cannot be used.

    The message is one sentence that names the file, the place in it and the remedy; the command
    line prints it and exits with status 2.
    """


def require(module: str, extra: str) -> ModuleType:
    """Import `module`, or raise `InputError` naming the extra of jaxevent that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"this needs the package {module.partition('.')[0]!r}: pip install 'jaxevent[{extra}]'"
        ) from error
