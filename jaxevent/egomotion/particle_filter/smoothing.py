"""A filter's motion in the light of later events."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxevent.egomotion.motion import Motion
from jaxevent.egomotion.particle_filter.parameters import Params

_diffusions = eqx.filter_jit(
    lambda model, params, means: jax.vmap(model.diffusion, (None, 0))(params, means)
)


def smoothed(motion: Motion, params: Params | None = None) -> Motion:
    """A motion in the light of later events too, and at the times that its events show.

    The filter's means and covariances, taken for those of a Kalman filter with the process noise of
    `params`, are passed backwards as by Rauch, Tung and Striebel: with G = P (P + Q)^-1,

        m_s = m + G (m_s' - m),  P_s = P + G (P_s' - P - Q) G',

    where ' is the next batch. That halves the variance and takes away the delay with which the
    filter answers to a change; `lag`, by which candidates are older, is taken off `t`. A stretch in
    which the motion is searched for separates what is before from what is after.
    """
    model = motion.model()
    params = Params(preset=model.preset) if params is None else params
    if not len(motion):
        return motion
    m, P = motion.mean.astype(float), motion.covariance.astype(float)
    padded = np.zeros((1 << (len(m) - 1).bit_length(), model.dimension))  # compiles for few sizes
    padded[: len(m)] = m
    noise = np.asarray(_diffusions(model, params, jnp.asarray(padded)))[: len(m)]
    dt = np.diff(motion.t, append=motion.t[-1]) * 1e-6
    Q = np.eye(model.dimension) * (noise**2 * dt[:, None])[:, None, :]
    # Covariances of headings have no spread along them, and those of few particles none at all.
    tiny = 1e-9 * np.trace(P, axis1=1, axis2=2)[:, None, None] + 1e-12
    G = np.linalg.solve(P + Q + tiny * np.eye(model.dimension), P).transpose(0, 2, 1)
    for k in range(len(m) - 2, -1, -1):
        if not (motion.valid[k] and motion.valid[k + 1]):
            continue
        m[k] += G[k] @ (m[k + 1] - m[k])
        P[k] += G[k] @ (P[k + 1] - P[k] - Q[k]) @ G[k].T
        for part in model.parts:
            if part.direction:
                m[k, part.rows] /= np.linalg.norm(m[k, part.rows])
    lag = np.rint(1e6 * motion.lag).astype(np.int64)
    t = np.maximum.accumulate(motion.t - lag)
    return dataclasses.replace(
        motion,
        t=t,
        mean=m.astype(motion.mean.dtype),
        covariance=P.astype(motion.mean.dtype),
        lag=np.zeros_like(motion.lag),
    )
