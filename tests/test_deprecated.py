"""Old public names give what has the new ones, with a warning."""

import importlib
from importlib.machinery import ModuleSpec

import pytest

from jaxevent import deprecated


@pytest.mark.parametrize("old", sorted(deprecated.RENAMED))
def test_old_names_give_the_new_objects(old):
    home, _, name = old.rpartition(".")
    with pytest.warns(DeprecationWarning) as warned:  # of a module that moved, too
        found = getattr(importlib.import_module(home), name)
    assert str(warned[-1].message).endswith("use " + deprecated.RENAMED[old])
    new_home, _, new_name = deprecated.RENAMED[old].rpartition(".")
    assert found is getattr(importlib.import_module(new_home), new_name)


@pytest.mark.parametrize("old", sorted(deprecated.MOVED_MODULES))
def test_old_modules_lead_to_the_new_ones(old):
    with pytest.warns(DeprecationWarning, match="use " + deprecated.MOVED_MODULES[old]):
        module = deprecated.RenamedModules().create_module(
            ModuleSpec(old, deprecated.RenamedModules())
        )
    new = importlib.import_module(deprecated.MOVED_MODULES[old])
    public = [name for name in vars(new) if not name.startswith("_")]
    assert public and all(getattr(module, name) is getattr(new, name) for name in public)


def test_unknown_names_are_refused_as_ever():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        deprecated.renamed_names("jaxevent.blob")("nonsense")
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("jaxevent.nonsense")
