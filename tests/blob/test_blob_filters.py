"""The blob filters against dense NumPy versions, the authors' program, and the laws they obey."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, linalg
from traced import FULL, products

from jaxevent import blob
from jaxevent.blob.filter import EventBatch, association_weights
from jaxevent.blob.filters.motion import gated_moments
from jaxevent.blob.quantities import inverse_ttc, log_size

TRACKERS = ("moment", "chi2_split", "chi2", "constant_velocity")


def tracker_of(name):
    return getattr(blob, name)


def params_of(name="moment", **values):
    return tracker_of(name).Params(**values)


def scanned(name, params, position, size, events, gate=None, report=None):
    """`report(state)` after each step; a gate in standard deviations sets weights to 0."""
    steps = tracker_of(name).filter
    report = report or (lambda state: steps.readout(params, state))

    def step(state, event):
        dt, xi, age, polarity, weight = event
        state = steps.predict(params, state, dt)
        if gate:
            prediction = steps.predicted_measurement(params, state)
            e = xi - (prediction.p - prediction.v * age[:, None])
            inverse = jnp.linalg.inv(prediction.spread + prediction.P_p)
            distance = jnp.einsum("mi,ij,mj->m", e, inverse, e)
            if params.gate_shape == "circle":
                distance = (e**2).sum(1) / prediction.size.max() ** 2
            weight = weight * (distance < gate**2)
        state = steps.update(params, state, EventBatch(xi, age, polarity), weight)
        return state, report(state)

    start = steps.init(params, jnp.asarray(position), jnp.asarray(size))
    return jax.lax.scan(step, start, events)


def random_events(seed, steps, m):
    """Gaps (some 0), events about a moving place, ages, polarities and weights (some 0)."""
    rng = np.random.default_rng(seed)
    dt = rng.exponential(3e-4, steps) * (rng.random(steps) < 0.8)
    dt[steps // 2] = 0.02
    xi = rng.normal(size=(steps, m, 2)) * [9, 4] + 500 * np.cumsum(dt)[:, None, None]
    age = np.sort(rng.random((steps, m)) * 1e-4)[:, ::-1]
    weight = np.where(rng.random((steps, m)) < 0.5, 1, rng.random((steps, m)))
    weight[rng.random((steps, m)) < 0.2] = 0
    return dt, xi, age, rng.choice([-1.0, 1.0], (steps, m)), weight


# ---- The oracles: ten states px py vx vy l1 l2 theta q dx dy, dense, one joint update per step.


def transition(params, dt, l2):
    """F and Q by the matrix exponential of van Loan; l2 (2,) divides the noise of the sizes."""
    A, W = np.zeros((10, 10)), np.zeros((10, 10))
    A[0, 2] = A[1, 3] = A[6, 7] = 1
    if params.tau_q > 0:
        A[7, 7] = -1 / float(params.tau_q)
    v = {name: float(getattr(params, name)) for name in params.numbers}
    noise = [v["Q_p"]] * 2 + [v["Q_v"]] * 2 + list(v["Q_lambda"] / l2)
    np.fill_diagonal(W, noise + [v["Q_theta"], v["Q_q"]] + [v["Q_d"]] * 2)
    both = linalg.expm(np.block([[-A, W], [np.zeros((10, 10)), A.T]]) * dt)
    F = both[10:, 10:].T
    return F, F @ both[:10, 10:]


def started(params, position, size):
    v = {name: float(getattr(params, name)) for name in params.numbers}
    x = np.zeros(10)
    x[:2], x[4:6] = position, np.log(size)
    P = [v["P0_p"]] * 2 + [v["P0_v"]] * 2 + [v["P0_lambda"] / v["lambda0"] ** 2] * 2
    d = v["P0_d"] * params.polarity_offset
    return x, np.diag(P + [v["P0_theta"], v["P0_q"], d, d])


def in_px(x, P):
    per = np.concatenate([np.ones(4), np.exp(x[4:6]), np.ones(2)])
    return np.r_[x[:4], np.exp(x[4:6]), x[6:8]], P[:8, :8] * np.outer(per, per)


def predicted(params, x, P, dt):
    F, Q = transition(params, dt, np.exp(2 * x[4:6]))
    if not params.polarity_offset:
        Q[8:] = 0
    return F @ x, F @ P @ F.T + Q


def capped(x, P, limits):
    """Variances cut to limits, covariances by the same factor: gains stay what they were."""
    P = P.copy()
    for i, limit in limits.items():
        factor = min(1, limit / P[i, i])
        variance = P[i, i] * factor
        P[i] *= factor
        P[:, i] *= factor
        P[i, i] = variance
    return P


def rotation(theta):
    return np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])


def kalman(x, P, C, innovation, R):
    K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    return x + K @ innovation, (np.eye(len(x)) - K @ C) @ P


def residual_rows(params, x, xi, age, polarity, weight):
    """Residuals, the mean one's derivative -C by the state, total weight, mean age."""
    offset = params.polarity_offset
    e = xi - (x[:2] - x[2:4] * age[:, None] + polarity[:, None] * x[8:] * offset)
    m = weight.sum()
    C = np.zeros((2, 10))
    C[:, :2], C[:, 2:4] = np.eye(2), -np.eye(2) * (weight @ age) / m
    C[:, 8:] = np.eye(2) * (weight @ polarity) / m * offset
    return e, C, m, weight @ age / m


def moment_oracle(_, params, position, size, events):
    x, P = started(params, position, size)
    kappa, fourth = (float(a) for a in gated_moments(params))
    for dt, xi, age, polarity, weight in zip(*events, strict=True):
        x, P = predicted(params, x, P, dt)
        if weight.sum() > 0:
            P = capped(x, P, {4: 1, 5: 1, 6: float(params.P_theta_max)})
            e, C, m, a = residual_rows(params, x, xi, age, polarity, weight)
            R = rotation(x[6] - a * x[7])
            l1, l2 = np.exp(x[4:6])
            spread = R @ np.diag([l1**2, l2**2]) @ R.T
            own = R.T @ C @ P @ C.T @ R
            u = e @ R
            S = (weight[:, None, None] * u[:, :, None] * u[:, None]).sum(0) / m
            V = kappa * np.array([l1, l2]) ** 2 + np.diag(own)
            rows, innovations, noises = [], [], []
            for i, size in enumerate((l1, l2)):
                row = np.zeros(10)
                row[4 + i] = (3 * fourth - kappa**2) * size**2
                rows.append(row)
                innovations.append(S[i, i] - V[i])
                p = own[i, i]
                noises.append(
                    ((3 * fourth - kappa**2) * size**4 + 4 * kappa * size**2 * p) / m + 2 * p**2
                )
            row = np.zeros(10)
            row[6], row[7] = fourth * (l1**2 - l2**2), -a * fourth * (l1**2 - l2**2)
            rows.append(row)
            innovations.append(S[0, 1] - own[0, 1])
            p1, p2 = np.diag(own)
            noises.append(
                (fourth * l1**2 * l2**2 + kappa * (l1**2 * p2 + l2**2 * p1)) / m
                + p1 * p2
                + own[0, 1] ** 2
            )
            mean = weight @ e / m
            C = np.vstack([C, rows])
            noise = linalg.block_diag(spread / m, np.diag(noises))
            before = x[4:6]
            x, P = kalman(x, P, C, np.r_[mean, innovations], noise)
            # The mean of an inverse gamma distribution, not the Kalman filter's.
            slope = (3 * fourth - kappa**2) * np.array([l1, l2]) ** 2 / V
            x[4:6] = before + np.log(1 + slope * (x[4:6] - before)) / slope
        yield in_px(x, P)


@jax.jit
def scaled(x, e, theta, polarity, age, weight):
    """L^-1 of a step's mean residual and sum of |L^-1 e|^2; e and theta before x is subtracted."""
    share = weight / weight.sum()
    mean_age = share @ age
    angle = theta + x[6] - mean_age * x[7]
    R = jnp.stack([jnp.cos(angle), -jnp.sin(angle), jnp.sin(angle), jnp.cos(angle)]).reshape(2, 2)
    inverse = R @ jnp.diag(jnp.exp(-x[4:6])) @ R.T
    e = e - (x[:2] - x[2:4] * age[:, None] + polarity[:, None] * x[8:])
    return inverse @ (share @ e), (weight * ((e @ inverse) ** 2).sum(1)).sum()


scaled_slopes = jax.jit(jax.jacfwd(scaled))


def window_oracle(name, params, position, size, events):
    """chi2 and chi2_split with whole past events, Jacobians by automatic differentiation."""
    x, P = started(params, position, size)
    past, split, n = [], name == "chi2_split", params.n
    for dt, xi, age, polarity, weight in zip(*events, strict=True):
        x, P = predicted(params, x, P, dt)
        if weight.sum() > 0:
            P = capped(x, P, {0: 1e6, 1: 1e6, 4: 1, 5: 1, 6: float(params.P_theta_max)})
            e, _, m, a = residual_rows(params, x, xi, age, polarity, weight)
            trusted = np.linalg.eigvalsh(P[:2, :2])[-1] <= 0.25 * np.exp(2 * x[4:6].min())
            args = (x, xi, 0.0, polarity * params.polarity_offset, age, weight)
            h, g = (np.array(part) for part in scaled(*args))
            C, C_g = (np.array(part) for part in scaled_slopes(*args))
            full = len(past) >= n - 1
            if split or not (full and trusted):
                C[:, 4:6] = 0
            if not trusted:
                C[:, 6:8] = 0
            rows, innovation, noise = [*C], [*-h], [1 / m, 1 / m]
            if full and trusted:
                window = past[-(n - 1) :] if n > 1 else []
                W = m + sum(w.sum() for _, _, w in window)
                scale = 1 / (1 + float(params.beta))
                if split:
                    for i in range(2):
                        found = weight @ (e @ rotation(x[6] - a * x[7]))[:, i] ** 2
                        found += scale * sum(w @ (f @ rotation(t))[:, i] ** 2 for f, t, w in window)
                        row = np.zeros(10)
                        row[4 + i] = -2 * W
                        rows.append(row)
                        innovation.append(W - found * np.exp(-2 * x[4 + i]))
                        noise.append(2 * W * n)
                else:
                    if not params.current_in_jacobian:
                        C_g[[0, 1, 2, 3, 6, 7, 8, 9]] = 0
                    still = np.r_[np.zeros(4), x[4:6], np.zeros(4)]
                    for f, t, w in window:
                        old = (still, f, t, np.zeros(len(w)), np.zeros(len(w)), w)
                        g = g + scale * scaled(*old)[1]
                        C_g[4:6] += scale * np.array(scaled_slopes(*old)[1])[4:6]
                    rows.append(C_g)
                    innovation.append(2 * W + (4 if params.target == "2n+4" else 0) - g)
                    noise.append(4 * W)
            if trusted:
                past.append((e, x[6] - a * x[7], weight))
            x, P = kalman(x, P, np.array(rows), np.array(innovation), np.diag(noise))
        yield in_px(x, P)


def constant_velocity_oracle(_, params, position, size, events):
    x, P = started(params, position, size)
    for dt, xi, age, polarity, weight in zip(*events, strict=True):
        x, P = predicted(params, x, P, dt)
        if weight.sum() > 0:
            e, C, m, _ = residual_rows(params, x, xi, age, polarity, weight)
            x, P = kalman(x, P, C, weight @ e / m, np.eye(2) * size**2 / m)
        yield np.r_[x[:4], size, size, 0, 0], linalg.block_diag(P[:4, :4], np.zeros((4, 4)))


SETTINGS = [
    (3, "moment", {"gate": 2.5, "polarity_offset": True, "tau_q": 0.01}, moment_oracle),
    (3, "chi2_split", {"gate_shape": "circle", "tau_q": 0.01, "beta": 0.2}, window_oracle),
    (3, "chi2", {"n": 7, "target": "2n"}, window_oracle),
    (1, "chi2", {"polarity_offset": True, "current_in_jacobian": True}, window_oracle),
    (3, "constant_velocity", {"polarity_offset": True}, constant_velocity_oracle),
]


@pytest.mark.slow
@pytest.mark.parametrize(("m", "name", "values", "oracle"), SETTINGS)
def test_filters_equal_a_dense_joint_version(m, name, values, oracle):
    params = params_of(name, **values)
    events = random_events(3 + m, 70, m)
    _, (mean, P) = jax.jit(lambda e: scanned(name, params, [3.0, -2.0], 12.0, e))(events)
    for k, (x, S) in enumerate(oracle(name, params, [3.0, -2.0], 12.0, events)):
        np.testing.assert_allclose(mean[k], x, rtol=1e-9, atol=1e-9)
        scale = np.sqrt(np.diag(S)) + 1e-9
        np.testing.assert_allclose(
            P[k] / np.outer(scale, scale), S / np.outer(scale, scale), atol=1e-9
        )


def test_moving_moments_are_weighted_sums():
    name = "moving_moments"
    params = params_of(name, tau_moments=0.004)
    dt, xi, age, polarity, weight = random_events(5, 60, 3)
    state, _ = jax.jit(lambda e: scanned(name, params, [3.0, -2.0], 12.0, e))(
        (dt, xi, age, polarity, weight)
    )
    now = dt.sum()
    at = np.cumsum(dt)[:, None] - age
    w = weight * np.exp(-(now - np.cumsum(dt)) / 0.004)[:, None]
    t, x, w = np.r_[0, at.ravel()], np.vstack([[3, -2], xi.reshape(-1, 2)]), w.ravel()
    first = np.exp(-now / 0.004)  # the start counts as one event with the spread of its size
    w = np.r_[first, w]
    w, mass = w / w.sum(), w.sum()
    center, when = w @ x, w @ t
    e, s = x - center, t - when
    spread = (w * e.T) @ e + w[0] * 144 * np.eye(2)
    prediction = jax.jit(tracker_of(name).filter.predicted_measurement)(params, state)
    np.testing.assert_allclose(prediction.p, center, rtol=1e-10)
    np.testing.assert_allclose(prediction.v, (w * s) @ e / (w @ s**2), rtol=1e-9)
    np.testing.assert_allclose(prediction.spread, spread, rtol=1e-10)
    np.testing.assert_allclose(prediction.P_p, spread / mass, rtol=1e-9)


def test_truncation_factors_are_integrals_over_the_gate():
    gate = 2.0
    params = params_of(gate=gate, gate_shape="ellipse")
    kappa, fourth = gated_moments(params)

    def mean(f, size=1.0):
        """Over (size z1, z2) that fall into the gate, for z standard normal."""

        def cut(g):
            return integrate.dblquad(
                lambda r, a: (
                    g(r * np.cos(a), r * np.sin(a))
                    * np.exp(-((r * np.cos(a) / size) ** 2 + (r * np.sin(a)) ** 2) / 2)
                    * r
                ),
                0,
                2 * np.pi,
                0,
                gate,
            )[0]

        return cut(f) / cut(lambda x, y: 1.0)

    np.testing.assert_allclose(kappa, mean(lambda x, y: x**2), rtol=1e-6)
    np.testing.assert_allclose(fourth, mean(lambda x, y: x**2 * y**2), rtol=1e-6)
    h = 1e-3  # the slope of the mean square against the log of the true size
    slope = mean(lambda x, y: x**2, np.exp(h)) - mean(lambda x, y: x**2, np.exp(-h))
    np.testing.assert_allclose(3 * fourth - kappa**2, slope / (2 * h), rtol=1e-5)


# ---- The authors' program.


@jax.jit
def authors_states(params, position, size, events):
    return scanned("chi2", params, position, size, events, report=lambda s: (s.x, s.P))[1]


@pytest.mark.parametrize(("name", "offset"), [("lights_mini", False), ("ties_mini", True)])
def test_the_authors_updates(data, name, offset):
    with np.load(data.parent / "golden" / "aeb" / f"{name}.npz") as file:
        prefix = "upd10" if offset else "upd8"
        rows, wanted_P, at = (file[prefix + end] for end in ("", "_P", "_P_index"))
        config = str(file["config_yaml"])

    def setting(key):
        return [float(part) for part in re.search(key + r": \[?([^\]\n]*)", config)[1].split(",")]

    (size,) = setting("lambda_init")
    starts = np.stack([setting("position_x_init"), setting("position_y_init")], 1)
    params = params_of("chi2", preset="authors", polarity_offset=offset)
    d = 10 if offset else 8
    for target, position in enumerate(starts):
        own = np.flatnonzero(rows[:, 1] == target)
        t, xi = rows[own, 0], rows[own, 2:4]
        events = (
            np.diff(t, prepend=t[0]),
            xi[:, None],
            np.zeros((len(t), 1)),
            np.where(rows[own, 4] > 0, 1.0, -1.0)[:, None],
            np.ones((len(t), 1)),
        )
        # Filled up to one length, so that one program serves all targets.
        fill = len(rows) - len(t)
        events = [np.pad(part, [(0, fill), *[(0, 0)] * (part.ndim - 1)]) for part in events]
        x, P = (part[: len(t)] for part in authors_states(params, position, size, events))
        np.testing.assert_allclose(x, rows[own, 5 : 5 + d], rtol=1e-9, atol=1e-9)
        both, i, j = np.intersect1d(own, at, return_indices=True)
        assert len(both) > 20
        np.testing.assert_allclose(P[i], wanted_P[j][:, :d, :d], rtol=1e-9, atol=1e-9)


# ---- Laws.


def leaves(state):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state)]


@functools.partial(jax.jit, static_argnums=0)
def later(name, params, events):
    return scanned(name, params, [3.0, -2.0], 12.0, events)[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*TRACKERS, "moving_moments"])
def test_no_weight_and_no_events(name):
    """Weights of 0 change nothing bit for bit; two predictions are one over both gaps."""
    steps = tracker_of(name).filter
    update, predict = jax.jit(steps.update), jax.jit(steps.predict)
    for tau_q in (0.0, 0.05):
        params = params_of(name, tau_q=tau_q, polarity_offset=name != "chi2_split")
        state = later(name, params, random_events(0, 40, 2))
        batch = EventBatch(jnp.array([[1.0, jnp.nan], [2e9, 3]]), jnp.zeros(2), jnp.ones(2))
        after = update(params, state, batch, jnp.zeros(2))
        for new, old in zip(leaves(after), leaves(state), strict=True):
            np.testing.assert_array_equal(new, old)
        for first, second in [(1e-5, 3e-4), (0.02, 0.01), (1.3, 40.0), (0.0, 0.5)]:
            once = predict(params, state, jnp.asarray(first + second))
            twice = predict(params, predict(params, state, jnp.asarray(first)), jnp.asarray(second))
            for a, b in zip(leaves(once), leaves(twice), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["moment", "chi2_split", "chi2", "moving_moments"])
def test_nothing_breaks_the_numbers(name, float32, optimised):
    """Gaps of 1000 s, equal times and sizes, far outliers, no weight, 10,000 events at a pixel."""
    params = params_of(name, polarity_offset=True, gate_shape="ellipse")
    xi = np.zeros((10_060, 1, 2), np.float32)
    xi[:20] = np.random.default_rng(0).normal(size=(20, 1, 2)) * 8
    xi[30] = [[1200, 700]]
    dt = np.full(10_060, 1e-5, np.float32)
    dt[[10, 11, 25]] = 1e3
    dt[12:18] = 0
    dt[-50] = 1e3
    one = np.ones((10_060, 1), np.float32)
    weight = one.copy()
    weight[5:8] = 0
    sign = one * (1 - 2 * (np.arange(10_060) % 2))[:, None].astype(np.float32)
    events = tuple(jnp.asarray(a) for a in (dt, xi, 0 * one, sign, weight))
    steps = tracker_of(name).filter

    def report(state):
        mean, P = steps.readout(params, state)
        prediction = steps.predicted_measurement(params, state)
        scale = jnp.sqrt(jnp.diagonal(P))
        skew = (jnp.abs(P - P.T) / (scale * scale[:, None] + 1e-30)).max()
        return mean, jnp.diagonal(P), skew, jnp.linalg.det(prediction.spread), prediction.P_p

    state, (mean, variances, skew, det, P_p) = jax.jit(
        lambda e: scanned(name, params, [3.0, -2.0], 10.0, e, report=report)
    )(events)
    for part in (mean, variances, det, P_p, *leaves(state)):
        assert np.isfinite(part).all()
    assert (variances >= 0).all() and (det > 0).all() and skew.max() < 1e-5
    assert (np.diagonal(P_p, axis1=1, axis2=2) > 0).all()
    assert np.abs(mean[-1, :2]).max() < 5  # 50 events after the last gap


def test_products_are_of_full_precision():
    """GPUs round the factors of others to 11 bits."""
    params = params_of("chi2", polarity_offset=True)
    events = tuple(jnp.ones(shape) for shape in [(3,), (3, 2, 2), (3, 2), (3, 2), (3, 2)])
    found = products(lambda e: scanned("chi2", params, [3.0, -2.0], 10.0, e)[0].P, events)
    blob = jnp.ones(8), jnp.eye(8)
    found += products(inverse_ttc, *blob, *blob) + products(log_size, *blob)
    assert len(found) > 5 and set(found) == {FULL}


@pytest.mark.slow
def test_gradient_of_the_likelihood():
    """That of `chi2` is in test_blob_authors.py."""
    events = random_events(8, 100, 1)
    events[0][60] = 1.0

    def loss(params):
        steps = tracker_of("moment").filter

        def step(state, event):
            dt, xi, age, polarity, weight = event
            state = steps.predict(params, state, dt)
            prediction = steps.predicted_measurement(params, state)
            S = prediction.spread + prediction.P_p
            e = xi[0] - prediction.p
            nll = e @ jnp.linalg.inv(S) @ e / 2 + jnp.log(jnp.linalg.det(S)) / 2
            return steps.update(params, state, EventBatch(xi, age, polarity), weight), nll

        start = steps.init(params, jnp.zeros(2), jnp.asarray(8.0))
        return jax.lax.scan(step, start, events)[1].sum()

    params = params_of("moment")
    both = jax.jit(jax.value_and_grad(loss))
    gradient = both(params)[1].raw
    for key in ("Q_p", "Q_v", "Q_lambda", "Q_theta", "Q_q"):
        h = 1e-5
        up, down = (float(both(params.with_raw({key: params.raw[key] + d}))[0]) for d in (h, -h))
        np.testing.assert_allclose(gradient[key], (up - down) / (2 * h), rtol=1e-5, atol=2e-6)


# ---- Statistics over seeds.


def random_walks(params, seeds, steps, dt, size, walk):
    """Truth (seeds, steps, 8) of the model's own process, and one event at each step."""
    rng = np.random.default_rng(11)
    v = {name: float(getattr(params, name)) for name in params.numbers}

    def normal(variance, *shape):
        return rng.normal(size=(seeds, steps, *shape)) * np.sqrt(variance)

    def integrated(first, Q_rate, Q, *shape):
        """A Wiener rate and its integral, which has noise of its own."""
        kick = normal(Q_rate * dt, *shape)
        rate = first[:, None] + np.cumsum(kick, 1)
        own = normal(Q_rate * dt**3 / 12 + Q * dt, *shape)
        return np.cumsum((rate - kick / 2) * dt + own, 1), rate

    p, velocity = integrated(normal(v["P0_v"], 2)[:, 0], v["Q_v"], v["Q_p"], 2)
    p += normal(v["P0_p"], 2)[:, :1]
    theta, q = integrated(normal(v["P0_q"] * walk)[:, 0], v["Q_q"] * walk, v["Q_theta"] * walk)
    theta += normal(v["P0_theta"] * walk)[:, :1]
    sizes = size + np.cumsum(normal(v["Q_lambda"] * dt * walk, 2), 1)
    e = normal(1, 2) * sizes
    c, s = np.cos(theta), np.sin(theta)
    xi = p + np.stack([c * e[..., 0] - s * e[..., 1], s * e[..., 0] + c * e[..., 1]], -1)
    return np.concatenate([p, velocity, sizes, theta[..., None], q[..., None]], -1), xi


@functools.partial(jax.jit, static_argnames=("name", "gate", "m"))
def reports(name, params, xi, dt, size, gate, m):
    """Mean, variances and the position's covariance after each step of m events, of all seeds."""
    filter = tracker_of(name).filter
    k = xi.shape[1] // m
    one = jnp.ones((k, m))
    age = one * jnp.arange(m)[::-1] * dt

    def report(state):
        mean, P = filter.readout(params, state)
        return mean, jnp.diagonal(P), P[:2, :2]

    def run(xi):
        events = (jnp.full(k, m * dt), xi.reshape(k, m, 2), age, one, one)
        return scanned(name, params, [0.0, 0.0], size, events, gate, report)[1]

    return jax.vmap(run)(xi)


def errors(name, params, truth, xi, dt, size, gate=None, m=1):
    """Errors after each step, and normalised squared ones of the position and of each state."""
    mean, variances, P = reports(name, params, xi, dt, size, gate, m)
    error = np.array(mean - truth[:, m - 1 :: m])
    error[..., 6] = (error[..., 6] + np.pi / 2) % np.pi - np.pi / 2
    position = np.einsum("...i,...ij,...j->...", error[..., :2], np.linalg.inv(P), error[..., :2])
    return error, position / 2, error**2 / np.maximum(variances, 1e-30)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "target"), [(5, "2n"), (5, "2n+4")])
def test_bias_of_the_paper_and_without_it(n, target):
    """The stationary size of eq. 11-23 is sqrt((n + 1) / (n - 1)) times the true one."""
    dt, size = 1e-5, 8.0
    params = params_of("chi2", n=n, target=target, Q_lambda=1, beta=1e-4)
    truth, xi = random_walks(params, 64, 4000, dt, np.array([size, size]), False)
    error, _, _ = errors("chi2", params, truth, xi, dt, size)
    measured = 1 + error[:, 1500:, 4:6].mean() / size
    law, tolerance = (np.sqrt((n + 1) / (n - 1)), 0.015) if target == "2n" else (1, 0.01)
    assert abs(measured - law) < tolerance, measured


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "gate", "m"),
    [("moment", None, 1), ("moment", "ellipse", 32), ("chi2_split", "ellipse", 1)],
)
def test_errors_are_as_large_as_predicted(name, gate, m):
    """With truth of the model's own noise; of sizes that stay constant the variance is half P."""
    dt, size = 1e-5, np.array([10.0, 5.0])
    values = {"P0_theta": 0.05, "gate_shape": gate or "circle"}
    params = params_of(name, events_per_step=m, **values)
    truth, xi = random_walks(params, 64, 6016, dt, size, True)
    error, position, nees = errors(name, params, truth, xi, dt, 8.0, gate and 3.5, m)
    tail = slice(2000 // m, None)
    bias = (error[:, tail, 4:6] / truth[:, m - 1 :: m][:, tail, 4:6]).mean((0, 1))
    assert np.abs(bias).max() < 0.025, bias
    assert 0.7 < position[:, tail].mean() < 1.3
    nees = nees[:, tail].mean((0, 1))
    assert ((0.7 < nees[4:6]) & (nees[4:6] < 1.3)).all(), nees


@pytest.mark.slow
def test_events_may_share_a_step():
    dt, size = 1e-5, np.array([10.0, 5.0])
    params = params_of("moment", gate_shape="circle")  # a program that has been compiled above
    truth, xi = random_walks(params, 64, 6016, dt, size, True)

    def rmse(m):
        error, _, _ = errors("moment", params, truth, xi, dt, 8.0, m=m)
        return np.sqrt((error[:, 1984 // m :: 32 // m, :2] ** 2).sum(-1).mean())

    assert abs(rmse(32) - rmse(1)) < 0.02


@pytest.mark.parametrize("clutter", [0.0, 1e-3])
def test_one_target_shares_with_clutter_alone(clutter):
    params = blob.moment.Params(clutter=clutter)
    for density in (-3.0, 2.0, -200.0, 90.0):
        other = jnp.array([False, True]), jnp.array([50.0, density])
        one = association_weights(params, jnp.array([True]), jnp.array([density]))
        np.testing.assert_allclose(
            one[0], association_weights(params, *other)[1], rtol=1e-5, atol=1e-30
        )
        assert association_weights(params, jnp.array([False]), jnp.array([density]))[0] == 0
    slope = jax.grad(lambda d: association_weights(params, jnp.array([True]), d[None])[0])(
        jnp.array(-200.0)
    )
    assert np.isfinite(slope)
