import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses

from jaxevent import Events, InputError, Recording
from jaxevent.camera import (
    SCurve,
    TableResponse,
    UnknownResponse,
    estimate_response,
    merge_exposures,
)

GREY = np.arange(256) / 255

pytestmark = pytest.mark.slow


def test_table_of_a_gamma_curve_inverts_it_and_gives_its_slope():
    grey = np.linspace(0, 1, 4001)
    camera = TableResponse(grey**2.0)  # CRF(E) = sqrt(E), dCRF/dE = 1 / (2 grey)
    at = jnp.asarray([0.2, 0.4001, 0.8])
    np.testing.assert_allclose(camera.intensity(at), at**2, atol=1e-7)
    ratio = camera.certainty(at[:1]) / camera.certainty(at[2:])
    np.testing.assert_allclose(ratio, 4, rtol=1e-6)


def test_unknown_response_is_surest_at_mid_grey():
    certainty = UnknownResponse().certainty(jnp.asarray([0.0, 0.25, 0.5, 1.0]))
    np.testing.assert_allclose(certainty, [0, 0.75, 1, 0])


def test_authors_table_is_used_as_certainty(golden):
    """kappa max(w, w_min) is what their recordings store as f_Q; intensity stays linear."""
    f_Q = np.load(golden / "mini_akf_deblur_hfr300.npz")["in_f_Q"]
    camera = recorded(f_Q=f_Q).response
    w = np.maximum(camera.certainty(GREY), 0.09)
    np.testing.assert_allclose(f_Q.max() * w, f_Q, rtol=2e-5)
    np.testing.assert_allclose(camera.intensity(GREY), GREY, atol=1e-12)


def test_recording_without_a_response_has_an_unknown_one():
    assert isinstance(recorded().response, UnknownResponse)


def test_recording_gives_the_response_that_it_carries():
    levels, weights = np.linspace(0, 1, 11) ** 2, np.linspace(1, 3, 11)
    camera = recorded(response=levels, f_Q=np.ones(256)).response
    np.testing.assert_allclose(camera.levels, levels)
    np.testing.assert_allclose(camera.weights, TableResponse(levels).weights)
    camera = recorded(response=levels, certainty=weights).response
    np.testing.assert_allclose(camera.weights, weights / 3)


@pytest.mark.parametrize(
    ("extra", "key"),
    [
        ({"f_Q": np.ones(255)}, "f_Q"),
        ({"response": np.ones((2, 8))}, "response"),
        ({"response": np.linspace(0, 1, 8), "certainty": np.ones(9)}, "certainty"),
        ({"response": np.array([0.0, 1.0, np.nan])}, "response"),
        ({"response": np.array(["a", "b", "c"])}, "response"),
    ],
)
def test_recording_refuses_responses_of_other_shapes(extra, key):
    with pytest.raises(InputError, match=f"street: extra.*{key}"):
        _ = recorded(**extra).response


def recorded(**extra) -> Recording:
    return Recording("street", 4, 4, Events.empty(), extra=extra)


@pytest.mark.parametrize(
    ("levels", "weights"), [([0, 1], None), ([0, 0.6, 0.4], None), ([0, 0.5, 1], [1, 2])]
)
def test_tables_that_mean_nothing_are_refused(levels, weights):
    refuses("camera response", TableResponse, levels, weights)


CAMERAS = [
    UnknownResponse(),
    SCurve(),
    SCurve(cut=115, steepness=1.5),
    SCurve(0, 20.0),
    TableResponse(np.linspace(0, 1, 33) ** 2.2),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_grey_inverts_intensity_and_clips(camera):
    np.testing.assert_allclose(camera.grey(camera.intensity(GREY)), GREY, atol=1e-12)
    scene = np.linspace(-0.5, 1.5, 41)
    np.testing.assert_allclose(camera.grey(scene), camera.grey(np.clip(scene, 0, 1)), atol=1e-15)
    np.testing.assert_allclose(camera.grey(np.array([-3.0, 0, 1, 3])), [0, 0, 1, 1], atol=1e-15)


@pytest.mark.parametrize("camera", CAMERAS)
def test_single_precision_inverts_too(camera, float32):
    camera = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), camera)
    grey = GREY.astype(np.float32)
    again = camera.grey(camera.intensity(grey))
    assert again.dtype == jnp.float32
    np.testing.assert_allclose(again, grey, atol=5e-7)


def test_flat_parts_of_a_table_have_one_of_their_grey_values():
    camera = TableResponse([0, 0, 0.3, 0.3, 1, 1])
    intensity = np.array([0, 0.15, 0.3, 0.65, 1.0])
    grey = camera.grey(intensity)
    np.testing.assert_allclose(camera.intensity(grey), intensity, atol=1e-15)
    assert (np.diff(grey) > 0).all()


@pytest.mark.parametrize("steepness", [0.5, 8.0, 15.0])
def test_s_curve_is_a_logistic_with_the_slope_as_certainty(steepness):
    camera = SCurve(50, steepness)
    E = np.linspace(0, 1, 201)
    logistic = 1 / (1 + np.exp(-steepness * (E - 0.5)))
    expected = (logistic - logistic[0]) / (logistic[-1] - logistic[0])
    np.testing.assert_allclose(camera.grey(E), expected, atol=1e-13)
    assert (np.diff(camera.grey(E)) > 0).all()

    inner, grey = E[1:-1], jax.jit(lambda E: camera.grey(E))
    slope = jax.jit(jax.vmap(jax.grad(lambda E: camera.grey(E))))(inner)
    h = 1e-6
    finite = (grey(inner + h) - grey(inner - h)) / (2 * h)
    np.testing.assert_allclose(slope, finite, rtol=1e-6)
    w = camera.certainty(camera.grey(inner))
    np.testing.assert_allclose(w, slope / slope[99], rtol=1e-9)
    assert np.argmax(w) == 99 and w[99] == 1


def test_s_curve_crops_the_levels_of_an_image():
    camera = SCurve(cut=80)
    np.testing.assert_allclose(camera.scene([80, 127.5, 175]), [0, 0.5, 1])
    np.testing.assert_allclose(camera.scene(np.uint8([30, 255])), [-50 / 95, 175 / 95])
    np.testing.assert_allclose(camera.level(camera.scene(GREY * 255)), GREY * 255, atol=1e-12)
    np.testing.assert_allclose(camera.grey(camera.scene([0, 80, 175, 255])), [0, 0, 1, 1])


def test_table_of_an_s_curve_is_that_curve():
    camera = SCurve(30, 6.0)
    table = TableResponse(camera.table(4001))
    np.testing.assert_allclose(table.intensity(GREY), camera.intensity(GREY), atol=1e-6)
    np.testing.assert_allclose(table.certainty(GREY[1:-1]), camera.certainty(GREY[1:-1]), atol=1e-5)
    assert camera.table().shape == (256,)


def test_s_curve_is_differentiable_in_its_parameters():
    def value(steepness, cut):
        camera = SCurve(cut, steepness)
        return camera.intensity(jnp.asarray(0.3)) + camera.grey(camera.scene(100))

    h = 1e-5
    by_steepness, by_cut = jax.jit(jax.grad(value, (0, 1)))(8.0, 50.0)
    value = jax.jit(value)
    np.testing.assert_allclose(
        by_steepness, (value(8 + h, 50) - value(8 - h, 50)) / (2 * h), rtol=1e-7
    )
    np.testing.assert_allclose(by_cut, (value(8, 50 + h) - value(8, 50 - h)) / (2 * h), rtol=1e-7)


@pytest.mark.parametrize("at", ["intensity", "grey"])
def test_tables_are_differentiable_in_their_intensities(at):
    camera = TableResponse(np.linspace(0, 1, 9) ** 2)
    points = jnp.asarray([0.11, 0.47, 0.9])

    def total(camera):
        return (jnp.arange(1, 4) * getattr(camera, at)(points)).sum()

    gradient = eqx.filter_grad(total)(camera).levels
    for entry in range(9):
        moved = [
            eqx.tree_at(lambda c: c.levels, camera, camera.levels.at[entry].add(step))
            for step in (1e-6, -1e-6)
        ]
        finite = (total(moved[0]) - total(moved[1])) / 2e-6
        np.testing.assert_allclose(gradient[entry], finite, atol=1e-6)
    assert np.count_nonzero(gradient) >= 4


@pytest.mark.parametrize("settings", [(-1, 8), (127.5, 8), (50, 0), (50, 21), (50, np.nan)])
def test_s_curves_that_mean_nothing_are_refused(settings):
    refuses("camera", SCurve, *settings)


EXPOSURES = np.array([2.0, 1 / 8, 1 / 4, 8, 1 / 2, 1, 4])


def bracketed(camera, exposures=EXPOSURES, noise=1.0, seed=0, shape=(90, 120)):
    """A scene of 3.5 decades, each pixel at random, and its noisy images: radiance, images."""
    rng = np.random.default_rng(seed)
    radiance = np.exp(rng.uniform(-5.5, 2.5, shape))
    grey = np.stack([np.asarray(camera.grey(radiance * t)) for t in exposures])
    levels = 255 * grey + rng.normal(0, noise, grey.shape)
    return radiance, np.clip(np.rint(levels), 0, 255).astype(np.uint8)


GAMMA = TableResponse(np.linspace(0, 1, 1001) ** 2.2)


@pytest.mark.parametrize(("camera", "tolerance"), [(SCurve(50), 0.05), (GAMMA, 0.01)])
@pytest.mark.parametrize("seed", [0, 1])
def test_response_is_recovered_from_an_exposure_stack(camera, tolerance, seed):
    _, images = bracketed(camera, seed=seed)
    found = estimate_response(images, EXPOSURES / 100, seed=seed)
    levels = np.asarray(found.levels)
    truth = np.asarray(camera.intensity(GREY))
    assert (np.diff(levels) >= 0).all() and levels[-1] == 1
    inside = slice(5, 251)
    np.testing.assert_allclose(levels[inside], truth[inside], atol=tolerance)
    # The intensity of level 255 is extrapolated and scales all others: without it they fit better.
    scale = np.median(levels[64:192] / truth[64:192])
    np.testing.assert_allclose(levels[32:224] / scale, truth[32:224], rtol=0.03)
    # No further out: at level 5 the gamma curve is steepest, and there the certainty is largest.
    w = np.asarray(found.certainty(GREY)) / found.certainty(GREY[128])
    expected = np.asarray(camera.certainty(GREY)) / camera.certainty(GREY[128])
    np.testing.assert_allclose(w[24:232], expected[24:232], atol=0.2)
    np.testing.assert_array_equal(found.weights[:5], 0)
    np.testing.assert_array_equal(found.weights[251:], 0)


def test_response_of_a_linear_camera_is_linear():
    _, images = bracketed(UnknownResponse(), noise=0.0)
    found = estimate_response(images, EXPOSURES, margin=1)
    np.testing.assert_allclose(found.levels[8:250], GREY[8:250], atol=0.004)


def test_response_is_the_same_for_the_same_seed_and_any_order_of_images():
    _, images = bracketed(SCurve(), shape=(60, 80))
    first = estimate_response(images, EXPOSURES)
    again = estimate_response(images, EXPOSURES)
    np.testing.assert_array_equal(first.levels, again.levels)
    order = np.argsort(EXPOSURES)
    sorted_ = estimate_response(images[order], EXPOSURES[order])
    np.testing.assert_allclose(sorted_.levels, first.levels, atol=1e-9)


def test_response_of_noisy_images_without_smoothness_does_not_fall():
    _, images = bracketed(UnknownResponse(), noise=4.0, shape=(40, 60))
    found = [
        np.asarray(estimate_response(images, EXPOSURES, smoothness=0.01, samples=1, seed=s).levels)
        for s in (0, 1)
    ]
    # Levels that the fit had in the wrong order share an intensity.
    assert (np.diff(found) >= 0).all() and (np.diff(found)[:, 5:250] == 0).any()
    assert np.abs(found[0] - found[1]).max() > 1e-6


def test_clipped_pixels_do_not_disturb_the_response():
    _, images = bracketed(SCurve(), shape=(60, 80))
    padded = np.concatenate([images, np.full((7, 60, 40), 255, np.uint8)], axis=2)
    padded = np.concatenate([padded, np.zeros((7, 60, 40), np.uint8)], axis=2)
    first, other = (
        estimate_response(stack, EXPOSURES, samples=1000).levels for stack in (images, padded)
    )
    np.testing.assert_allclose(first, other, atol=1e-9)


STACK = np.tile(np.arange(256, dtype=np.uint8), (2, 4, 1))


@pytest.mark.parametrize(
    ("images", "exposures", "message"),
    [
        (STACK[:1], [1.0], "two or more exposure times"),
        (STACK, [1.0, 1.0], "two or more exposure times"),
        (STACK, [1.0, 2.0, 3.0], "one exposure time for each image"),
        (STACK[0], [1.0, 2.0], "uint8"),
        (STACK.astype(np.uint16), [1.0, 2.0], "uint8"),
        (STACK, [1.0, -2.0], "positive"),
        (STACK, [1.0, np.inf], "positive"),
        (STACK[:, :1], [1.0, 2.0], "too few"),
        (np.where(STACK < 128, np.uint8(0), np.uint8(255)), [1.0, 2.0], "too few"),
        (STACK[:, :, 100:140].repeat(9, axis=1), [1.0, 2.0], "too few"),
    ],
)
def test_stacks_that_tell_no_response_are_refused(images, exposures, message):
    refuses(message, estimate_response, images, exposures)


@pytest.mark.parametrize("setting", [{"smoothness": 0}, {"samples": 0}, {"margin": 100}])
def test_settings_without_sense_are_refused(setting):
    refuses("margin", estimate_response, STACK, [1.0, 2.0], **setting)


@pytest.mark.parametrize("camera", [SCurve(50), GAMMA, UnknownResponse()])
@pytest.mark.parametrize("reference", [None, 0.5])
def test_merged_exposures_are_the_scene(camera, reference):
    radiance, images = bracketed(camera, noise=0.5)
    hdr, variance = merge_exposures(images, EXPOSURES, camera, reference=reference)
    truth = radiance * (EXPOSURES[0] if reference is None else reference)
    covered = (radiance * EXPOSURES.max() > 0.15) & (radiance * EXPOSURES.min() < 0.85)
    assert np.isfinite(variance[covered]).all()
    error = np.abs(hdr / truth - 1)[covered]
    assert np.median(error) < 0.006 and error.max() < 0.15


def test_merged_exposures_are_the_weighted_mean():
    images = np.array([[[100]], [[60]], [[254]]], np.uint8)
    hdr, variance = merge_exposures(images, [2.0, 1.0, 8.0], GAMMA)
    a, b = 100 / 255, 60 / 255
    wa, wb = (float(GAMMA.certainty(np.array(z))) for z in (a, b))
    expected = (wa * a**2.2 + wb / 4 * (b**2.2 * 2)) / (wa + wb / 4)
    np.testing.assert_allclose(hdr, [[expected]], rtol=1e-4)
    np.testing.assert_allclose(variance, [[1 / (wa + wb / 4)]], rtol=1e-12)


def test_where_all_exposures_clip_the_result_is_the_tightest_bound():
    # Saturated in both, dark in both, and dark in the short one where the long one is saturated.
    images = np.array([[[255, 2, 255]], [[255, 1, 3]]], np.uint8)
    hdr, variance = merge_exposures(images, [4.0, 1.0], UnknownResponse(), reference=1.0)
    np.testing.assert_allclose(hdr, [[1, 2 / 255 / 4, (1 / 4 + 3 / 255) / 2]])
    np.testing.assert_array_equal(variance, np.inf)


def test_frames_of_one_exposure_merge_to_their_intensity():
    images = np.arange(256, dtype=np.uint8)[None, None]
    hdr, _ = merge_exposures(images, [0.02], GAMMA)
    np.testing.assert_allclose(hdr, GAMMA.intensity(images[0] / 255), rtol=1e-12)


def test_merging_refuses_bad_stacks():
    refuses("uint8", merge_exposures, STACK.astype(float), [1.0, 2.0], UnknownResponse())
    refuses("reference", merge_exposures, STACK, [1.0, 2.0], UnknownResponse(), reference=0)
