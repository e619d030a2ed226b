"""A per-pixel filter from outside the package works wherever the package's own do.

`own_filter.trend` has a state of three numbers per pixel, one of them whole.
"""

import dataclasses
import json

import jax
import numpy as np
import pytest
from commands import fails
from noise import small
from own_filter import Params, trend

import jaxevent
from jaxevent import cli
from jaxevent.methods import find

PATH = "own_filter:trend"


def test_it_is_found_by_its_path():
    assert find(PATH) is trend and find(PATH, "reconstruction") is trend
    with pytest.raises(jaxevent.InputError, match="is of reconstruction, not of blob"):
        find(PATH, "blob")
    with pytest.raises(jaxevent.InputError, match="'own_filter:trends' cannot be imported"):
        find("own_filter:trends")
    with pytest.raises(jaxevent.InputError, match="is the class Params, not an Estimator"):
        find("own_filter:Params")


def by_hand(recording, params, times):
    """The images, by a loop over the events of each pixel."""
    c = {True: float(params.c_on), False: -float(params.c_off)}
    alpha, gain, tau = (float(getattr(params, n)) for n in ("alpha", "gain", "tau"))
    frames, events = recording.frames, recording.events
    level = np.log(frames.images / 255 + float(params.I0))
    stamps = np.array([-np.inf, *frames.t[1:]])
    out = np.empty((len(times), recording.height, recording.width))
    for y in range(recording.height):
        for x in range(recording.width):
            own = (events.x == x) & (events.y == y)
            for row, time in enumerate(times):
                L, D, at, last = level[0, y, x], 0.0, recording.start, recording.start
                moments = [
                    (int(t), bool(p)) for t, p in zip(events.t[own], events.p[own], strict=True)
                ]
                for t, p in [*[m for m in moments if m[0] <= time], (int(time), None)]:
                    # The last frame at the end of a gap pulls over all of it.
                    u = level[np.searchsorted(stamps, t, "right") - 1, y, x]
                    dt = (t - at) * 1e-6
                    fading, decay = np.exp(-dt / tau), np.exp(-alpha * dt)
                    L = (L + D * tau * (1 - fading)) * decay + u * (1 - decay)
                    D *= fading
                    if p is not None:
                        D += gain * (c[p] / max((t - last) * 1e-6, 1e-3) - D)
                        L, last = L + c[p], t
                    at = t
                out[row, y, x] = np.exp(L) - float(params.I0)
    return out


def test_it_equals_a_loop_over_events():
    recording, params = small(), Params(gain=0.3, alpha=20.0)
    times = np.array([9_000, 30_000, 52_000])
    image, variance, valid = trend.estimate(recording, params)(times)
    np.testing.assert_allclose(image, by_hand(recording, params, times), rtol=1e-10)
    assert valid.all() and (variance <= 0.01).all() and np.ptp(variance) > 0


@pytest.mark.slow
def test_its_gradients_are_right():
    recording, params = small(), Params(gain=0.3)
    times = np.array([9_000, 30_000, 52_000])
    features, out = trend.prepare(recording, times, params)

    @jax.jit
    def loss(params):
        image, variance, _ = trend.read(params, trend.run(params, features)[0], out)
        return (image**2).sum() + variance.sum()

    slope = jax.jit(jax.grad(loss))(params)
    for name in ("gain", "tau", "alpha", "c_on"):
        up, down = (loss(params.with_raw({name: params.raw[name] + h})) for h in (1e-5, -1e-5))
        assert slope.raw[name] == pytest.approx(float(up - down) / 2e-5, rel=1e-6), name


@pytest.fixture
def folder(tmp_path):
    jaxevent.save(small(), tmp_path / "small.h5")
    return tmp_path


@pytest.mark.slow
def test_it_is_evaluated(folder, capsys):
    config = folder / "run.toml"
    config.write_text(
        f'recordings = ["small.h5"]\n[[method]]\nname = "{PATH}"\nlabel = "trend"\n'
        'grid = { gain = [0.1, 0.3] }\n[[method]]\nname = "blend"\n'
    )
    assert cli.main(["evaluate", str(config), "--out", str(folder / "out")]) == 0
    rows = json.loads((folder / "out" / "results.json").read_text())["rows"]
    assert [row["method"] for row in rows] == ["trend, gain 0.1", "trend, gain 0.3", "blend"]
    assert rows[0]["params"]["gain"] == 0.1 and rows[0]["mse"] != rows[1]["mse"]
    assert "trend, gain 0.3" in capsys.readouterr().out


@pytest.mark.slow
def test_it_is_fitted(folder, capsys):
    config = folder / "fit.toml"
    config.write_text(
        'recordings = ["small.h5"]\nsplit = [1, 1, 1]\niterations = 3\nrounds = 1\nevery = 1\n'
        f'[[method]]\nname = "{PATH}"\nlabel = "trend"\nfit = ["gain", "alpha"]\n'
    )
    assert cli.main(["fit", str(config), "--out", str(folder / "fitted")]) == 0
    fitted = Params.load(folder / "fitted" / "params.toml", "trend")
    assert float(fitted.gain) != pytest.approx(0.1, rel=1e-6)
    assert "trend, before" in capsys.readouterr().out
    config.write_text(config.read_text().replace('"alpha"', '"rho_ref"'))
    fails(capsys, ["fit", config, "--out", folder / "no"], config, "search = { rho_ref = [")


def test_it_reconstructs(folder, capsys):
    argv = ["reconstruct", folder / "small.h5", "--method", PATH, "--rate", "200"]
    assert cli.main([str(word) for word in [*argv, "--out", folder / "out.h5"]]) == 0
    assert (folder / "out.h5").exists() and "11 images" in capsys.readouterr().out
    fails(capsys, [*argv[:3], "own_filter:Params", "--out", folder / "b.h5"], "own_filter:Params")


def test_a_method_without_its_frames_says_so():
    recording = dataclasses.replace(small(), frames=None)
    with pytest.raises(jaxevent.InputError, match="holds no frames"):
        trend.estimate(recording)
