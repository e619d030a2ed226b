"""The preset "authors" against what the authors' program told, from raw events on.

The golden files hold all events, whose each is, and states after some of them: of the program with
its polarity offset (upd10) and without (upd8). Pixels count from 1 there.
"""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxevent
from jaxevent.blob import chi2
from jaxevent.blob.authors import DISPLAY, WAITING
from jaxevent.cli import main
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

NAMES = ("blob_mini", "lights_mini", "ties_mini")


@functools.cache
def golden_of(folder, name):
    """A recording, its seeds, and the file's tables."""
    with np.load(folder / f"aeb_{name}.npz") as file:
        tables = {key: file[key] for key in file.files}
    config = str(tables["config_yaml"])

    def setting(key):
        found = re.search(rf"^{key}\s*: *\[?([^\]\n#]*)", config, re.MULTILINE)
        return [float(part) for part in found[1].split(",")]

    raw = tables["events_x_y_p_tus"][int(setting("event_num_start")[0]) :].astype(np.int64)
    x, y, p, t = raw.T
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), p > 0)
    width, height = (int(setting(key)[0]) for key in ("width", "height"))
    starts = zip(setting("position_x_init"), setting("position_y_init"), strict=True)
    seeds = [(x - 1, y - 1, setting("lambda_init")[0]) for x, y in starts]
    return Recording(name, width, height, events), seeds, tables


run = jax.jit(chi2.run)


def followed(recording, seeds, **values):
    """Targets after each event: a pytree whose arrays begin with (events, targets)."""
    params = chi2.Params(preset="authors", **values)
    features, _ = chi2.prepare(recording, [], params, seeds=seeds)
    slots, _ = run(params, features)
    valid = np.asarray(features.valid)[..., 0]
    return jax.tree.map(lambda a: np.asarray(a)[:, 1:][valid], slots)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("offset", [False, True])
def test_the_authors_program(golden, name, offset):
    recording, seeds, tables = golden_of(golden, name)
    slots = followed(recording, seeds, polarity_offset=offset)
    key, columns = "upd10" if offset else "upd8", list(tables["columns"])
    count = len(tables["events_x_y_p_tus"]) - len(recording.events)  # events left out before

    # Which events move which target.
    before = np.concatenate([np.full((1, len(seeds)), -1), slots.last[:-1]])
    before[1:] = slots.hits[:-1]
    changed = (np.diff(slots.state.x, axis=0, prepend=np.nan) != 0).any(-1)
    changed[0] = slots.hits[0] > 0
    wanted = np.zeros_like(changed)
    event, target = tables[f"{key}_event_target"].T
    wanted[event - 1 - count, target] = True
    last = event[-1] - count
    np.testing.assert_array_equal(changed[:last], wanted[:last])

    # And where to.
    d, rows = 10 if offset else 8, tables[key]
    event = rows[:, columns.index("event_id")].astype(int) - 1 - count
    target = rows[:, columns.index("target")].astype(int)
    x = slots.state.x[event, target] + np.pad([1.0, 1.0], (0, d - 2))
    i = columns.index("px")
    np.testing.assert_allclose(x, rows[:, i : i + d], 1e-9, 1e-9)
    P = np.diagonal(slots.state.P, axis1=-2, axis2=-1)[event, target]
    i = columns.index("P_px")
    np.testing.assert_allclose(P, rows[:, i : i + d], 1e-9, 1e-9)
    radius = rows[:, columns.index("dist_threshold")]
    np.testing.assert_allclose(slots.gate[event, target], radius, 1e-9, 1e-9)
    if name != "lights_mini":  # it ends before the gate adapts
        assert (rows[:, 0] > 0.026).sum() > 20 and radius[-1] > 10.001
