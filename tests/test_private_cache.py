"""The folder of compiled programs is the user's alone, or is not used."""

import os
import shutil
import stat

import pytest

from jaxevent import cache

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs users and modes")


def mode(path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def base(tmp_path, monkeypatch):
    """A folder that does not exist yet, named as the user's cache."""
    monkeypatch.setenv("JAXEVENT_CACHE", str(tmp_path / "deep" / "cache"))
    return tmp_path / "deep" / "cache"


def test_folders_and_keys_are_made_for_the_user_alone(base):
    before = os.umask(0)
    try:
        folder = cache.folder_for_compiled()
        assert folder is not None
        key = cache.secret_key(folder)
    finally:
        os.umask(before)
    assert folder.parent == base and key is not None and len(key) == 32
    assert [mode(p) for p in (folder, base, base.parent)] == [0o700] * 3
    assert mode(folder / "key") == 0o600
    assert os.listdir(folder) == ["key"]


@pytest.mark.parametrize("place", ["folder", "base"])
@pytest.mark.parametrize("open_to", [0o770, 0o707])
def test_a_folder_that_others_may_write_to_is_not_used(place, open_to, base):
    folder = cache.folder_for_compiled()
    (folder if place == "folder" else base).chmod(open_to)
    cache._own_folder.cache_clear()
    with pytest.warns(UserWarning, match="other users may write to it"):
        assert cache.folder_for_compiled() is None
    assert cache.folder_for_compiled() is None  # said once


def test_a_folder_that_was_removed_is_made_again(base):
    folder = cache.folder_for_compiled()
    key = cache.secret_key(folder)
    shutil.rmtree(base)
    assert cache.folder_for_compiled() == folder and folder.is_dir()
    assert cache.secret_key(folder) not in (None, key)


def test_a_folder_that_others_may_read_is_used(base):
    base.mkdir(parents=True, mode=0o755)
    assert cache.folder_for_compiled() is not None


def test_a_folder_of_another_user_is_not_used(base, monkeypatch):
    cache.folder_for_compiled()
    cache._own_folder.cache_clear()
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    with pytest.warns(UserWarning, match=f"the user {user} owns it"):
        assert cache.folder_for_compiled() is None


def as_new_process(folder):
    cache.secret_key.cache_clear()
    return cache.secret_key(folder)


def test_processes_have_the_same_key(tmp_path):
    key = as_new_process(tmp_path)
    assert as_new_process(tmp_path) == key
    other = tmp_path / "other"
    other.mkdir()
    assert as_new_process(other) != key


def test_a_key_made_by_another_process_meanwhile_is_taken(tmp_path, monkeypatch):
    link, others = os.link, [b"k" * 32]

    def late(source, target):
        if others:
            target.write_bytes(others.pop())
            target.chmod(0o600)
        link(source, target)

    monkeypatch.setattr(os, "link", late)
    assert as_new_process(tmp_path) == b"k" * 32


@pytest.mark.parametrize("how", ["readable", "short", "linked", "foreign"])
def test_a_key_that_others_may_know_is_replaced(how, tmp_path, monkeypatch):
    known, path = b"known to everyone, of 32 bytes ..", tmp_path / "key"
    known = known[:32]
    path.write_bytes(known[:5] if how == "short" else known)
    path.chmod(0o644 if how == "readable" else 0o600)
    if how == "linked":
        path.rename(tmp_path / "elsewhere")
        path.symlink_to(tmp_path / "elsewhere")
    if how == "foreign":
        monkeypatch.setattr(cache, "_foreign_access", lambda status: "another user owns it")
        assert as_new_process(tmp_path) is None  # nor is what this user makes there
        monkeypatch.undo()
    key = as_new_process(tmp_path)
    assert len(key) == 32 and key != known
    assert mode(path) == 0o600 and not path.is_symlink()


def test_where_no_key_can_be_written_there_is_none(tmp_path):
    assert as_new_process(tmp_path / "nowhere") is None
