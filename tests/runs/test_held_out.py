"""Frames hidden with gaps, errors where something moves, and honest variances, by hand."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from noise import HEIGHT, WIDTH, hdr_recording, small, write_config
from numpy.typing import NDArray

import jaxevent
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.methods import METHODS
from jaxevent.reconstruction.filtering import Filter
from jaxevent.recording import Frames, Recording
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.protocols import held_out
from jaxevent.runs.reconstruction import Objective, Problem, cut_windows
from jaxevent.runs.scores import score, subset

I0, VARIANCE = 0.5, 0.04


@dataclasses.dataclass(frozen=True, repr=False)
class Certain(Filter):
    """A blend that tells the variance 0.04, but none of the first pixel."""

    def read(self, params, trajectory, out):
        image, _, valid = super().read(params, trajectory, out)
        return Estimate(image, jnp.full_like(image, VARIANCE).at[:, 0].set(jnp.nan), valid)


def certain() -> Certain:
    blend = METHODS["blend"]
    return Certain(
        **{field.name: getattr(blend, field.name) for field in dataclasses.fields(blend)}
    )


def longer(count: int = 11) -> Recording:
    """`small` with more frames, of which a part never changes and some pixels are clipped."""
    images = np.random.default_rng(2).integers(1, 255, (count, 20, 24)).astype(np.uint8)
    images[:, :, :9] = images[0, :, :9]
    images[:, 3, 9:14], images[:, 4, 14:] = 0, 255
    stamps = np.arange(count) * 5_000
    return small(frames=Frames(stamps, images, np.zeros_like(stamps)))


def blended(recording: Recording, gap: int) -> tuple[list[int], NDArray]:
    """Which frames are hidden, and the blends in their places."""
    grey = np.asarray(recording.frames.images) / 255
    hidden = [k for k in range(len(grey)) if k % gap]
    images = []
    for k in hidden:
        before, after = k // gap * gap, (k // gap + 1) * gap
        share = (k - before) / gap if after < len(grey) else 0
        images.append((1 - share) * grey[before] + share * grey[min(after, len(grey) - 1)])
    return hidden, np.array(images)


@pytest.mark.parametrize("gap", [2, 3, 4])
def test_rows_with_a_gap_are_those_by_hand(gap):
    recording = longer()
    grey = np.asarray(recording.frames.images) / 255
    hidden, images = blended(recording, gap)
    params = METHODS["blend"].Params(I0=I0)
    row = score(recording, certain(), params, gap=gap, moving=True)
    assert row["per_frame"]["t"] == recording.frames.t[hidden].tolist()
    assert row.get("gap", 2) == gap and ("gap" in row) == (gap != 2)
    truth = grey[hidden]
    errors = (images - truth) ** 2
    np.testing.assert_allclose(row["per_frame"]["mse"], errors.mean((1, 2)), rtol=1e-6)
    # Where something moves.
    moves = []
    for k in hidden:
        before, after = k // gap * gap, (k // gap + 1) * gap
        known = after < len(grey)
        moves.append(np.abs(grey[after] - grey[before]) > 0.05 if known else 0 * grey[0] > 0)
    moves = np.array(moves)
    assert not moves[:, :, :9].any() and 0.3 < moves.mean() < 0.6
    assert row["moving"]["share"] == pytest.approx(moves.mean())
    assert row["moving"]["mse"] == pytest.approx(errors[moves].mean(), rel=1e-6)
    last = row["per_frame"]["moving"]["mse"][-1]
    assert (last is None) == (not moves[-1].any())
    # What is black, white but for noise, or without a variance tells nothing of the variance.
    z2 = np.log((images + I0) / (truth + I0)) ** 2 / VARIANCE
    counts = (truth > 0) & (truth < 0.98)
    counts[:, 0, 0] = False
    each = [one[mask] for one, mask in zip(z2, counts, strict=True)]
    np.testing.assert_allclose(row["per_frame"]["z2"], [one.mean() for one in each], rtol=1e-5)
    assert row["z2"] == pytest.approx(np.mean([one.mean() for one in each]), rel=1e-5)
    assert row["z2_median"] == pytest.approx(np.mean([np.median(one) for one in each]), rel=1e-5)
    likelihoods = scipy.stats.norm(np.log(images + I0), VARIANCE**0.5).pdf(np.log(truth + I0))
    nll = -np.log(likelihoods / (truth + I0))  # of intensity, not of its logarithm
    each = [one[mask].mean() for one, mask in zip(nll, counts, strict=True)]
    np.testing.assert_allclose(row["per_frame"]["nll"], each, rtol=1e-5)
    json.dumps(row, allow_nan=False)
    part = subset(row, [0, 1])
    assert part["moving"]["mse"] == pytest.approx(errors[:2][moves[:2]].mean(), rel=1e-6)
    plain = score(recording, METHODS["blend"], params, gap=gap)
    assert not {"moving", "z2", "z2_median", "nll"} & set(plain) and plain["mse"] == row["mse"]
    assert "z2" not in score(recording, certain(), params, gap=gap, normalise="affine")


def test_a_method_that_breaks_has_no_numbers():
    params = METHODS["blend"].Params(I0=I0)

    def broken(params, state, dt, frame):
        return dataclasses.replace(state, L=jnp.full_like(frame.level, jnp.nan))

    row = score(longer(), dataclasses.replace(certain(), predict=broken), params, moving=True)
    for name in ("mse", "z2", "z2_median", "nll"):
        assert row[name] is None
    assert row["moving"]["mse"] is None and row["moving"]["share"] > 0


def test_a_gap_is_given_and_hidden_wholly():
    recording = longer(10)
    given, hidden = held_out(recording, 4)
    assert given.frames.t.tolist() == recording.frames.t[[0, 4, 8]].tolist()
    assert hidden.t.tolist() == recording.frames.t[[1, 2, 3, 5, 6, 7, 9]].tolist()
    usual, default = held_out(recording, 2), held_out(recording)
    assert usual[0].frames.t.tolist() == default[0].frames.t.tolist()
    (part,) = cut_windows(recording, "held-out", gap=4)
    assert part.truth.t.tolist() == hidden.t.tolist()


@pytest.mark.parametrize("gap", [1, 0, -2, True])
def test_gaps_that_hide_nothing(gap):
    with pytest.raises(jaxevent.InputError, match="hides no frame; give a whole number"):
        held_out(longer(), gap)


def test_what_a_gap_cannot_be_used_for():
    with pytest.raises(jaxevent.InputError, match="6 frames; hiding every one but each 6th needs"):
        score(small(), METHODS["blend"], gap=6)
    with pytest.raises(jaxevent.InputError, match="'reference' hides no frames; omit gap"):
        score(hdr_recording(), METHODS["blend"], protocol="reference", gap=3)
    with pytest.raises(jaxevent.InputError, match="'reference' gives all frames; omit moving"):
        score(hdr_recording(), METHODS["blend"], protocol="reference", moving=True)


@pytest.mark.slow
def test_evaluations_take_gap_and_moving(tmp_path):
    jaxevent.save(longer(), tmp_path / "small.h5")
    text = 'recordings = ["small.h5"]\ngap = 3\nmoving = true\n[[method]]\nname = "blend"\n'
    rows = evaluate(write_config(tmp_path, text), tmp_path / "out")
    expected = score(longer(), METHODS["blend"], gap=3, moving=True)
    assert rows[0]["method"] == "blend, gap 3" and rows[0]["gap"] == 3
    assert rows[0]["mse"] == expected["mse"] and rows[0]["moving"] == expected["moving"]
    assert "moving MSE x 1e-2" in (tmp_path / "out" / "results.md").read_text()
    for setting, said in (
        ("gap = 1", "gap is '1'; give a whole number of frames"),
        ("moving = 0.1", "moving is '0.1'; give true or false"),
        ('gap = 3\nprotocol = "reference"', "there is no setting 'gap'"),
    ):
        text = f'recordings = ["small.h5"]\n{setting}\n[[method]]\nname = "blend"\n'
        with pytest.raises(jaxevent.InputError, match=said):
            evaluate(write_config(tmp_path, text))


FIT = (
    'recordings = ["small.h5"]\nsplit = [1, 1, 1]\niterations = 1\nrounds = 1\nevery = 1\n'
    '[[method]]\nname = "edi"\nfit = ["c_on"]\n'
)


@pytest.mark.slow
def test_fits_take_a_gap(tmp_path):
    jaxevent.save(longer(), tmp_path / "small.h5")
    config = write_config(tmp_path, "gap = 3\n" + FIT)
    rows = jaxevent.fit(config, tmp_path / "fitted")
    hidden = held_out(longer(), 3)[1].t.tolist()
    times = sorted({t for row in rows for t in row["per_frame"]["t"]})
    assert times == hidden and {row["gap"] for row in rows} == {3}
    for text, said in (
        ("gap = 1\n", "gap is '1'"),
        ('gap = 3\nloss = "reference"\n', "gap is for frames that are hidden"),
    ):
        with pytest.raises(jaxevent.InputError, match=said):
            jaxevent.fit(write_config(tmp_path, text + FIT), tmp_path / "no")


def lit_by_a_camera() -> tuple[Recording, NDArray[np.float64]]:
    """A still scene behind a camera of a curved response, whose exposure changes; its intensity."""
    curve, gain = np.linspace(0, 1, 256) ** 2, np.array([1.0, 0.5, 0.7, 0.9, 1.0])
    scene = np.random.default_rng(5).uniform(0.2, 0.95, (HEIGHT, WIDTH))
    scene[0, 0] = 1.3  # which some of the exposures clip
    grey = np.sqrt((scene * gain[:, None, None]).clip(0, 1))
    t = 40_000 * np.arange(1, 6)
    frames = Frames(t, np.rint(65535 * grey).astype(np.uint16), 0 * t)
    extra = {"response": curve, "gain": gain}
    return dataclasses.replace(small(), frames=frames, extra=extra), scene


def test_intensity_is_that_of_the_scene_where_the_camera_is_known():
    recording, scene = lit_by_a_camera()
    frames, gain = recording.linear_frames, recording.gain
    expected = np.minimum(scene, 1 / gain[:, None, None])
    np.testing.assert_allclose(frames.intensity, expected, atol=1e-4)
    np.testing.assert_allclose(frames.limits, [[0, 1 / g] for g in gain], rtol=1e-6)
    np.testing.assert_allclose(frames[1:4:2].intensity, expected[1:4:2], atol=1e-4)
    plain = dataclasses.replace(recording, extra={})
    assert plain.linear_frames is plain.frames
    levels = {"f_Q": np.ones(256)}  # of a linear response, whose certainties alone are given
    assert dataclasses.replace(recording, extra=levels).linear_frames is recording.frames
    with pytest.raises(InputError, match="holds no frames"):
        print(dataclasses.replace(recording, frames=None, extra={}).linear_frames)


def test_a_right_image_has_no_error_whatever_the_camera():
    recording, _ = lit_by_a_camera()
    row = score(recording, certain(), METHODS["blend"].Params(I0=I0), moving=True)
    hidden = recording.linear_frames[1::2]
    given = recording.with_frames(slice(0, None, 2)).linear_frames.intensity
    for truth, (low, high), before, after, mse in zip(
        hidden.intensity, hidden.limits, given[:-1], given[1:], row["per_frame"]["mse"], strict=True
    ):
        image = ((before + after) / 2).clip(low, high)
        assert mse == pytest.approx(((image - truth) ** 2).mean(), abs=1e-9)
    assert row["mse"] < 1e-3, "grey values taken as intensity would be wrong by 0.1"
    assert row["moving"]["share"] < 0.5
    # A fit compares in the same way.
    method = METHODS["blend"]
    problem = Problem(Objective(method), cut_windows(recording, "held-out"))
    loss = float(problem.objective(method.Params(), problem(method.Params())[0][0]))
    assert 0 < loss < 1e-3
