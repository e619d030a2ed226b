"""Lens models: against OpenCV, there and back, and in files of recordings."""

import dataclasses

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxevent
from jaxevent.camera import LENS_MODELS, PinholeCamera, find_model
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

SIZE = (64, 48)
CAMERAS = {
    "radtan": PinholeCamera(60, 58, 31.5, 24.5, (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "rational": PinholeCamera(
        60, 58, 31.5, 24.5, (0.3, -0.1, 1e-3, -2e-3, 0.02, 0.4, -0.05, 0.01), "rational"
    ),
    "equidistant": PinholeCamera(30, 29, 31.5, 24.5, (0.05, -0.02, 0.01, -0.002), "fisheye"),
    "ideal fisheye": PinholeCamera(30, 29, 31.5, 24.5, model="equidistant"),
}
EVENTS = Events(
    np.arange(4) * 10, np.array([3, 60, 30, 1], "u2"), np.array([2, 40, 24, 47], "u2"),
    np.array([True, False, True, True]),
)  # fmt: skip


@pytest.mark.parametrize("name", CAMERAS)
def test_places_are_those_of_opencv(name):
    cv2 = pytest.importorskip("cv2")
    camera = CAMERAS[name]
    angle, around = np.mgrid[0:1.1:12j, 0:6.2:9j].reshape(2, -1)
    at = np.tan(angle)[:, None] * np.stack([np.cos(around), np.sin(around)], -1)
    if camera.model != "equidistant":
        at *= 0.3
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = np.concatenate([at, np.ones((len(at), 1))], -1)[:, None]
    k, still = np.array(camera.distortion), np.zeros(3)
    project = cv2.fisheye.projectPoints if camera.model == "equidistant" else cv2.projectPoints
    want = project(points, still, still, matrix, k)[0]
    np.testing.assert_allclose(camera.distort(at), want[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
def test_what_a_lens_does_is_undone(name):
    camera = CAMERAS[name]
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 64, 3), np.arange(0, 48, 3)))
    straight = camera.normalise(x, y)
    assert np.isfinite(straight).all()
    np.testing.assert_allclose(camera.distort(straight), np.stack([x, y], -1), atol=1e-6)


def test_a_fisheye_sees_angles_as_distances():
    camera = CAMERAS["ideal fisheye"]
    seen = camera.distort(np.array([[np.tan(1.0), 0], [np.tan(1.5), 0], [0, np.tan(0.5)]]))
    np.testing.assert_allclose(seen, [[61.5, 24.5], [76.5, 24.5], [31.5, 39.0]])


@pytest.mark.parametrize("model", LENS_MODELS)
def test_jacobians_are_differences(model):
    lens, k = LENS_MODELS[model], CAMERAS[model].distortion
    at = np.array([[0.0, 0.0], [0.3, -0.2], [-0.5, 0.4], [1e-3, 0.2]])
    _, jacobian = lens.distort(at, k)
    for axis, step in enumerate(np.eye(2) * 1e-6):
        difference = (lens.distort(at + step, k)[0] - lens.distort(at - step, k)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, axis], difference, atol=1e-8)


def test_beyond_its_turn_a_lens_shows_nothing():
    """The radius a - a^3 / 3 rises until the angle 1."""
    camera = PinholeCamera(30, 30, 0, 0, (-1 / 3,), "equidistant")
    at = np.tan([[0.99, 0], [1.01, 0]])
    assert np.isfinite(camera.distort(at)).tolist() == [[True] * 2, [False] * 2]
    inside, outside = camera.normalise(np.array([19.9, 20.1]), np.array([0, 0]))
    assert np.isfinite(inside).all() and np.isnan(outside).all()


def test_models_go_by_the_names_of_other_programs():
    names = {"plumb_bob": "radtan", "Fisheye": "equidistant", "rational_polynomial": "rational"}
    assert {name: find_model(name) for name in names} == names and find_model("fov") is None
    with pytest.raises(InputError, match="'fov' of a camera is not supported; give one of radtan"):
        PinholeCamera(1, 1, 0, 0, model="fov")
    with pytest.raises(InputError, match="has 5 coefficients; give at most 4, k1, k2, k3, k4"):
        PinholeCamera(1, 1, 0, 0, (0.0,) * 5, "equidistant")


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ((-200, 200, 9, 7), "focal lengths -200 and 200 px is not possible; give"),
        ((200, 0.0, 9, 7), "focal lengths 200 and 0.0 px is not possible; give"),
        ((np.inf, 200, 9, 7), "fx of a camera is inf; give"),
        ((200, 200, 9, np.nan), "cy of a camera is nan; give"),
        ((200, 200, -4001, 7), "cx = -4001 px, more than 87 degrees beside the sensor .*; give"),
        ((200, 200, 9, 1e6), "cy = 1000000.0 px, more than 87 degrees beside the sensor .*; give"),
        ((200, 200, 9, 7, (0.1, np.nan)), "k2 of a camera is nan; give"),
    ],
)
def test_a_camera_that_is_not_possible_is_refused_when_it_is_made(numbers, told):
    with pytest.raises(InputError, match=told):
        PinholeCamera(*numbers)


def test_a_recording_refuses_a_camera_that_looks_past_its_sensor():
    PinholeCamera(10, 10, 5000, 24)  # of a larger sensor
    recording = Recording("a", *SIZE, EVENTS, camera=PinholeCamera(10, 10, 262, 24))
    with pytest.raises(InputError, match="a: a camera with cx = 264 px, more than 87 degrees"):
        dataclasses.replace(recording, camera=PinholeCamera(10, 10, 264, 24))


def test_cameras_take_traced_numbers():
    def project(f, x):
        camera = PinholeCamera(f, 2 * f, -f, 5.0, (0.1 * f, 0.0))
        return camera.fx * x + camera.cx * camera.distortion[0]

    f, x = jnp.array([-2.0, 3.0]), 0.5  # the first is no camera, which a trace cannot see
    want = f * x - 0.1 * f**2
    np.testing.assert_allclose(jax.jit(project)(f[0], x), want[0], rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(project, (0, None))(f, x), want, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(project)(f[1], x), x - 0.2 * f[1], rtol=1e-6)


@pytest.mark.parametrize("name", ["radtan", "rational", "equidistant"])
def test_stored_recordings_keep_their_lens(name, tmp_path):
    camera = CAMERAS[name]
    jaxevent.save(Recording("a", *SIZE, EVENTS, camera=camera), tmp_path / "a.h5")
    assert jaxevent.load(tmp_path / "a.h5").camera == camera
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    columns = {one: getattr(EVENTS, one) for one in ("t", "x", "y", "p")}
    values = {**columns, "width": 64, "height": 48, "calib": numbers, "calib_model": name}
    np.savez(tmp_path / "a.npz", **values)
    assert jaxevent.load(tmp_path / "a.npz").camera == camera


def test_lenses_of_m3ed(tmp_path):
    for model in ("radtan", "equidistant", "fov"):
        with h5py.File(tmp_path / f"{model}.h5", "w") as file:
            group = file.create_group("prophesee/left")
            for name in ("t", "x", "y", "p"):
                group[name] = getattr(EVENTS, name)
            group["calib/intrinsics"] = [60.0, 58, 31.5, 24.5]
            group["calib/distortion_coeffs"] = [0.05, -0.02, 0.01, -0.002]
            group["calib/distortion_model"] = model
            group["calib/resolution"] = SIZE
    got = jaxevent.load(tmp_path / "equidistant.h5").camera
    assert got == dataclasses.replace(CAMERAS["equidistant"], fx=60, fy=58)
    assert jaxevent.load(tmp_path / "radtan.h5").camera.distortion[3:] == (-0.002, 0)
    missing = jaxevent.load(tmp_path / "fov.h5")
    assert missing.camera is None and "'fov'" in missing.describe_left_out("camera")
