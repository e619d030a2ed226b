"""Output that appears complete or not at all."""

import contextlib
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from jaxevent.errors import InputError


@contextlib.contextmanager
def complete(path: Path, directory: bool = False) -> Iterator[Path]:
    """Yield a temporary sibling of `path`, renamed onto `path` if the block succeeds.

    The sibling is an empty file, or an empty directory where `directory` is True. If the block
    raises, the sibling is removed and `path` is left as it was. An existing file is replaced; an
    existing directory must be empty.

    Raises:
        InputError: `path` is of the other kind, a directory that is not empty, or cannot be
            written; also instead of an OSError raised in the block.
    """
    path = Path(path)
    name = path.absolute().name
    if not name:
        raise InputError(f"{path}: is a folder; give the name of something to write in it")
    partial = path.absolute().with_name(f".{name}.{uuid.uuid4().hex[:12]}.part")
    try:
        _refuse(path, directory)
        if directory:
            partial.mkdir()
        else:
            partial.touch(exist_ok=False)
        yield partial
        if directory and path.exists():
            path.rmdir()
        partial.replace(path)
    except OSError as error:
        reason = " ".join((error.strerror or str(error)).split())
        raise InputError(
            f"{path}: cannot be written ({reason}); choose a writable place with enough room"
        ) from error
    finally:
        if directory:
            shutil.rmtree(partial, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                partial.unlink()


def _refuse(path: Path, directory: bool) -> None:
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    if directory and path.is_dir():
        if any(path.iterdir()):
            raise InputError(f"{path}: the folder is not empty; choose another or empty it")
    elif path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file to write")
    elif path.exists() and (directory or not path.is_file()):
        raise InputError(f"{path}: exists and is not what is to be written; choose another name")
