"""The errors that are the user's to mend: bad input, described in a sentence."""

import importlib
import json
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname


class InputError(ValueError):
    """A file, setting or argument cannot be used.

    The message is one sentence that names the file, the place in it and the remedy; the command
    line prints it and exits with status 2.
    """


class OrderError(InputError):
    """Event times go back."""


class InputWarning(UserWarning):
    """Something about the input is doubtful, but can be used.

    The message is one sentence that names the place and the remedy; the command line prints it.
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
            f"this needs the package {module.partition('.')[0]!r}: {install_command(extra)}"
        ) from error


def install_command(extra: str) -> str:
    """Return the command that installs an extra from where jaxevent itself came: `pip install ...`.

    A package that was installed from a folder or a repository names it in direct_url.json
    (packaging.python.org, "Recording the Direct URL Origin of installed distributions").
    """
    try:
        record = metadata.distribution("jaxevent").read_text("direct_url.json")
        origin: dict[str, Any] = json.loads(record or "{}")
    except metadata.PackageNotFoundError:
        # Not installed: Python finds a checkout on its path.
        checkout = Path(__file__).resolve().parents[1]
        if not (checkout / "pyproject.toml").is_file():
            return f"pip install 'jaxevent[{extra}]'"
        origin = {"url": checkout.as_uri(), "dir_info": {"editable": True}}
    url = origin.get("url", "")
    if "vcs_info" in origin:
        vcs = origin["vcs_info"]
        revision = f"@{vcs['requested_revision']}" if vcs.get("requested_revision") else ""
        return f"pip install 'jaxevent[{extra}] @ {vcs['vcs']}+{url}{revision}'"
    if "archive_info" in origin and urlsplit(url).scheme != "file":
        return f"pip install 'jaxevent[{extra}] @ {url}'"
    if "dir_info" not in origin and "archive_info" not in origin:
        return f"pip install 'jaxevent[{extra}]'"
    folder = Path(url2pathname(urlsplit(url).path))
    edited = "-e " if origin.get("dir_info", {}).get("editable") else ""
    return f"pip install {edited}'{'.' if folder == Path.cwd() else folder}[{extra}]'"
