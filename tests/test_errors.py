"""What is said of a missing extra works where the package came from."""

from importlib import metadata

import pytest

from jaxevent import errors
from jaxevent.errors import MissingExtra, install_command, require


@pytest.mark.parametrize(
    "origin, command",
    [
        (None, "pip install 'jaxevent[plot]'"),
        (
            '{"url": "https://f/j.whl", "archive_info": {}}',
            "pip install 'jaxevent[plot] @ https://f/j.whl'",
        ),
        ('{"url": "file:///a%20b/j.whl", "archive_info": {}}', "pip install '/a b/j.whl[plot]'"),
        (
            '{"url": "file:///some/where%20else", "dir_info": {"editable": true}}',
            "pip install -e '/some/where else[plot]'",
        ),
        ('{"url": "file:///some/where", "dir_info": {}}', "pip install '/some/where[plot]'"),
        (
            '{"url": "https://host/j.git", "vcs_info": {"vcs": "git", "commit_id": "a"}}',
            "pip install 'jaxevent[plot] @ git+https://host/j.git'",
        ),
        (
            '{"url": "https://host/j.git", "vcs_info": {"vcs": "git", "requested_revision": "v1", '
            '"commit_id": "a"}}',
            "pip install 'jaxevent[plot] @ git+https://host/j.git@v1'",
        ),
    ],
)  # fmt: skip
def test_the_command_is_that_of_the_origin(origin, command, monkeypatch):
    class Installed:
        def read_text(self, name):
            assert name == "direct_url.json"
            return origin

    monkeypatch.setattr(metadata, "distribution", lambda name: Installed())
    assert install_command("plot") == command
    with pytest.raises(MissingExtra, match="needs the package 'not_there': pip install"):
        require("not_there.inside", "plot")


def test_a_checkout_that_is_not_installed(monkeypatch, tmp_path):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", missing)
    root = tmp_path / "tree"
    (root / "jaxevent").mkdir(parents=True)
    monkeypatch.setattr(errors, "__file__", str(root / "jaxevent" / "errors.py"))
    assert install_command("plot") == "pip install 'jaxevent[plot]'"
    (root / "pyproject.toml").touch()
    assert install_command("plot") == f"pip install -e '{root}[plot]'"
    monkeypatch.chdir(root)
    assert install_command("plot") == "pip install -e '.[plot]'"
