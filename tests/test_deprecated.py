"""Old public names give what has the new ones, with a warning."""

import dataclasses
import importlib
from importlib.machinery import ModuleSpec
from importlib.resources import files
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxevent
from jaxevent import blob, deprecated
from jaxevent.reconstruction import augment, filtering, kalman
from jaxevent.reconstruction.smoother import Smoother


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


def test_the_old_method_of_parameters_gives_what_the_new_one_does():
    params = jaxevent.akf.Params()
    with pytest.warns(DeprecationWarning, match="use Params.names_without_gradient"):
        assert params.without_gradient() == params.names_without_gradient()


def test_unknown_names_are_refused_as_ever():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        deprecated.renamed_names("jaxevent.blob")("nonsense")
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("jaxevent.nonsense")


@pytest.mark.slow
def test_a_filter_with_old_names_gives_the_same_images(float32):
    """A method of a user's own, written for the release before: its classes, fields and methods."""
    crop = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")[0.6:0.65]
    time = 0.63
    with pytest.warns(DeprecationWarning):
        base = filtering.Observer

    with pytest.warns(DeprecationWarning, match="Frames.outset is deprecated"):

        class Frames(base):
            level: augment.AugmentedFrame

            def __init__(self, params, frames):
                self.level = augment.AugmentedFrame(params, frames)

            def __call__(self, points):
                level = self.level(points)
                return filtering.Observation(level, jnp.full_like(level, 5.0))

            def outset(self, points):
                return self(points).level + 0.1

    with pytest.warns(DeprecationWarning, match=r"Filter\.\w+ is deprecated"):
        old_names: Any = {
            "observe": Frames,
            "initial": kalman.init,
            "advance": kalman.predict,
            "jump": kalman.event_update,
        }
        old = filtering.Filter("own", kalman.Params, **old_names)
    new = filtering.Filter(
        "own", kalman.Params, Frames, kalman.init, kalman.predict, kalman.event_update
    )
    same = [method.estimate(crop)(time).mean for method in (old, new)]
    np.testing.assert_array_equal(*same)
    with pytest.warns(DeprecationWarning, match=r"Filter\.jump is deprecated"):
        assert old.jump is kalman.event_update
    tell: Any = {"tell": lambda params, state: (state.L, 2 * state.P)}
    with pytest.warns(DeprecationWarning, match=r"Filter\.tell is deprecated"):
        changed = dataclasses.replace(old, **tell)
    assert changed.readout is not old.readout


def test_old_methods_can_be_overridden():
    with pytest.warns(DeprecationWarning, match="Doubtful.tell is deprecated"):

        class Doubtful(Smoother):
            def tell(self, params, state, kept, here):
                return super().readout(params, state, kept, here)._replace(covariance=state.P + 1)

    method = Doubtful("doubtful", jaxevent.aks.Params)
    assert Doubtful.readout is Doubtful.__dict__["tell"]
    with pytest.warns(DeprecationWarning, match="looks_ahead is deprecated"):
        assert method.looks_ahead


def test_a_blob_filter_takes_and_gives_the_old_names_of_its_steps():
    for old, new in (("share", "association_weights"), ("expected", "predicted_measurement")):
        mine = lambda *given: None  # noqa: E731
        with pytest.warns(DeprecationWarning, match=f"use Filter.{new}"):
            filter = dataclasses.replace(blob.moment.filter, **{old: mine})
        with pytest.warns(DeprecationWarning, match=f"use Filter.{new}"):
            assert getattr(filter, new) is getattr(filter, old) is mine


def test_a_motion_estimator_takes_and_gives_the_old_name_of_its_adaptation():
    batch = jaxevent.egomotion.batch
    mine = lambda *given: {}  # noqa: E731
    with pytest.warns(DeprecationWarning, match=r"use HostEstimator\.adapt_lengths"):
        method = dataclasses.replace(batch, lengths=mine)
    with pytest.warns(DeprecationWarning, match=r"use HostEstimator\.adapt_lengths"):
        assert method.adapt_lengths is method.lengths is mine
