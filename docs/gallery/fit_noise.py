# %% [markdown]
# # Fit noise parameters by gradient
#
# First the least that a fit needs: frames that the filter does not see, and one number, here a
# threshold of the filter `akf`. `replace` sets what is fitted; the rest stays.

# %%
from importlib.resources import files

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import jaxevent
from jaxevent import akf, aks

packaged = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")[0.6:0.9]
given, hidden = packaged.with_frames(slice(0, None, 2)), packaged.frames[1::2]
params = akf.Params.for_recording(given)
times = hidden.t + round(1e6 * float(params.clock_offset))  # from stamps to the events' clock
images = akf.prepare_images(given, times, params)
pixels = hidden.intensity.reshape(len(hidden), -1)


@jax.jit
@jax.value_and_grad
def error(z):
    return jnp.mean((images(params.replace(c_on=jnp.exp(z))).mean - pixels) ** 2)


z, optimiser = jnp.log(0.2), optax.adam(0.05)  # z is ln(c_on), so that c_on stays positive
state = optimiser.init(z)
for _ in range(100):
    mse, slope = error(z)
    step, state = optimiser.update(slope, state)
    z += step
print(f"c_on from 0.2 to {jnp.exp(z):.3f}, d MSE / d ln(c_on) = {slope:.1e}")

# %% [markdown]
# A gradient by a whole `Params` is a `Params`, too: `gradient.raw["c_on"]` is the derivative by
# ln(c_on), `gradient.per_unit(params)["c_on"]` that by c_on.

# %%
gradient = jax.grad(lambda params: jnp.mean((images(params).mean - pixels) ** 2))(params)
gradient.raw["c_on"], gradient.per_unit(params)["c_on"]

# %% [markdown]
# Noises need no hidden frames: the likelihood of the frames given the events is a differentiable
# function of all parameters of the smoother `aks`. Here events and frames are drawn from its own
# model, so that the true parameters are known. optax finds them again from values that are two to
# three times too large.

# %%
TRUE = {"sigma_event": 0.12, "sigma_bg": 0.15, "sigma_frame": 0.01}
C, I0, GAP_US, FRAMES, SIZE = 0.1, 0.2, 20_000, 16, (32, 24)


def draw(seed):
    """Draw a recording: a random walk of ln(I + I0), observed by events and noisy frames."""
    rng = np.random.default_rng(seed)
    pixels = SIZE[0] * SIZE[1]
    level, drift = np.log(0.5) + rng.normal(0, 0.1, pixels), np.zeros(pixels)
    columns, images = [], []
    for k in range(FRAMES):
        noise = rng.normal(0, TRUE["sigma_frame"], pixels)
        images.append(np.clip(np.exp(level) - I0 + noise, 0, 1))
        where = np.repeat(np.arange(pixels), rng.poisson(4, pixels))
        t = np.sort(rng.integers(1, GAP_US, len(where))) + k * GAP_US
        rng.shuffle(where)
        # Polarity pulls pixels back to the middle: frames reach neither black nor white.
        on = rng.random(len(where)) < 1 / (1 + np.exp(6 * drift[where]))
        change = np.where(on, C, -C)
        np.add.at(drift, where, change)
        np.add.at(level, where, change + rng.normal(0, TRUE["sigma_event"] * C, len(where)))
        level += rng.normal(0, TRUE["sigma_bg"] * np.sqrt(GAP_US * 1e-6), pixels)
        columns.append((t, where % SIZE[0], where // SIZE[0], on))
    t, x, y, p = (np.concatenate(column) for column in zip(*columns, strict=True))
    stack = np.reshape(images, (FRAMES, SIZE[1], SIZE[0])).astype(np.float32)
    return jaxevent.Recording.from_arrays(
        t, x, y, p, width=SIZE[0], height=SIZE[1], frames=stack,
        frame_times=GAP_US * np.arange(FRAMES), time_unit="us", name="drawn",
    )  # fmt: skip


recording = draw(seed=100)
recording

# %% [markdown]
# `prepare` computes what depends on the data alone. `log_likelihood` sums over the frames' pixels.
# Noises are positive, so the loop steps their logarithms.

# %%
features, _ = aks.prepare(recording, recording.frames.t[-1:])
names = list(TRUE)
measurements = recording.frames.images.size


@jax.jit
@jax.value_and_grad
def loss(log_noises):
    noises = dict(zip(names, jnp.exp(log_noises), strict=True))
    params = aks.Params(c_on=C, c_off=C, I0=I0, sigma_floor=1e-4, w_min=1.0, share=0.0, **noises)
    return -aks.log_likelihood(params, features) / measurements


start = np.log([0.3, 0.4, 0.03])
log_noises, optimiser = jnp.asarray(start), optax.adam(0.1)
state, path, losses = optimiser.init(log_noises), [start], []
for _ in range(60):
    value, gradient = loss(log_noises)
    updates, state = optimiser.update(gradient, state)
    log_noises = optax.apply_updates(log_noises, updates)
    path.append(np.asarray(log_noises))
    losses.append(float(value))

# %% [markdown]
# The curvature of the likelihood gives the standard deviation of each estimate.

# %%
hessian = measurements * jax.jacfwd(lambda z: loss(z)[1])(log_noises)
deviation = np.sqrt(np.diag(np.linalg.inv(np.asarray(hessian, np.float64))))
found = np.exp(log_noises)
for name, value, relative in zip(names, found, deviation, strict=True):
    print(f"{name:12} true {TRUE[name]:.3f}, found {value:.4f} +- {value * relative:.4f}")

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
axes[0].plot(losses, label="loss")
axes[0].set(xlabel="iteration", ylabel="-ln p per measurement (nats)")
axes[0].legend()
for k, (name, values) in enumerate(zip(names, np.exp(path).T, strict=True)):
    axes[1].semilogy(values, f"C{k}", label=name)
    axes[1].axhline(TRUE[name], color=f"C{k}", linestyle=":")
    axes[1].errorbar(
        len(values),
        found[k],
        yerr=2 * found[k] * deviation[k],
        color=f"C{k}",
        marker="o",
        capsize=4,
    )
axes[1].plot([], [], "k:", label="truth")
axes[1].errorbar([], [], yerr=[], color="k", marker="o", label="found, 2 standard deviations")
axes[1].set(xlabel="iteration", ylabel="noise")
axes[1].legend(ncols=2, fontsize="small")

# %% [markdown]
# `jaxevent.fit` and `jaxevent.optimise` do this with validation, priors and intervals: [Fit and
# compare](../fitting.md).
