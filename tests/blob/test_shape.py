"""Covariance of a position by changes of the target's shape, against closed forms."""

import numpy as np
import pytest

from jaxevent.blob.shape import MIN_SHAPE_TIMES, fit_usual_sizes, shape_covariance

T = np.linspace(0, 2, 200)


def states(sizes, theta=0.0, error=0.0):
    """Return states (times, 8) of some sizes, and covariances with an error of their logarithm."""
    sizes = np.asarray(sizes, float)
    mean, covariance = np.zeros((len(sizes), 8)), np.zeros((len(sizes), 8, 8))
    mean[:, 4:6], mean[:, 6] = sizes, theta
    for i in (4, 5):
        covariance[:, i, i] = (error * mean[:, i]) ** 2
    return mean, covariance


def test_usual_sizes_are_those_of_most_times():
    sizes = np.tile([6.0, 3.0], (len(T), 1))
    sizes[60:100] *= 1.5
    usual = fit_usual_sizes(T, sizes)
    np.testing.assert_allclose(usual.at(T), np.tile([6.0, 3.0], (len(T), 1)))


@pytest.mark.parametrize("sign", [1, -1])
def test_an_approach_at_constant_velocity_is_no_change_of_shape(sign):
    sizes = np.stack([8 / (2.5 - T), 4 / (2.5 - T)], 1)[::sign]
    seen = sizes.copy()
    seen[80:100] *= 1.6
    usual = fit_usual_sizes(T, seen)
    np.testing.assert_allclose(usual.at(T), sizes, rtol=0.03)
    more = shape_covariance(usual, T, *states(seen))
    assert more[85:95, 0, 0].min() > 0.3 * sizes[90, 0] ** 2
    assert more[110:, 0, 0].max() < 0.01 * sizes[110:, 0].min() ** 2


def test_few_times_tell_no_usual_size():
    few = MIN_SHAPE_TIMES - 1
    assert fit_usual_sizes(T[:few], np.ones((few, 2))) is None


def test_covariance_of_a_known_change():
    usual = fit_usual_sizes(T, np.tile([6.0, 3.0], (len(T), 1)))
    now = np.array([[6.0, 3.0], [6 * np.exp(0.1), 3 * np.exp(-0.2)], [60.0, 30.0]])
    more = shape_covariance(usual, T[:3], *states(now, theta=np.pi / 2))
    # The mean of the squares, times 4; turned by a quarter the longer axis is that of y.
    share = np.array([0, 4 * (0.1**2 + 0.2**2) / 2, 1])[:, None, None]
    np.testing.assert_allclose(more, share * np.diag([9.0, 36.0]), atol=1e-12)


def test_the_middle_of_an_object_is_two_sizes_from_its_lone_edge():
    usual = fit_usual_sizes(T, np.tile([6.0, 3.0], (len(T), 1)), lone_edge=True)
    more = shape_covariance(usual, T[:2], *states([[6.0, 3.0]] * 2, theta=0.3))
    np.testing.assert_allclose(more, np.tile(144 * np.eye(2), (2, 1, 1)), atol=1e-9)


def test_changes_that_sizes_are_uncertain_by_add_nothing():
    usual = fit_usual_sizes(T, np.tile([6.0, 3.0], (len(T), 1)))
    now = np.array([[6.0, 3.0], [6.0, 3.0]]) * np.exp([[0.08], [0.2]])
    more = shape_covariance(usual, T[:2], *states(now, error=0.05))
    assert (more[0] == 0).all()
    np.testing.assert_allclose(more[1], 4 * (0.04 - 0.0025) * np.diag([36.0, 9.0]))


def test_the_error_of_a_mean_is_covered_where_another_target_comes_near():
    """Events of two blobs by turns: the mean of all is beside the first one by their share."""
    rng = np.random.default_rng(3)
    rows = []
    for share in np.repeat([0.0, 0.0, 0.0, 0.2], 10):
        x = rng.normal(0, 3, (400, 2))
        x[: int(share * 400), 0] += 9
        rows.append((x.mean(0), np.sort(x.std(0))[::-1]))
    error, sizes = (np.array(column) for column in zip(*rows, strict=True))
    mean, covariance = states(sizes, error=800**-0.5)
    covariance[:, :2, :2] = np.eye(2) * 9 / 400
    usual = fit_usual_sizes(T[: len(mean)], sizes)
    more = shape_covariance(usual, T[: len(mean)], mean, covariance)
    nees = error[:, 0] ** 2 / (covariance[:, 0, 0] + more[:, 0, 0])
    without = error[:, 0] ** 2 / covariance[:, 0, 0]
    assert without[30:].mean() > 50 and nees[30:].mean() < 3 and nees[:30].mean() < 1.5
