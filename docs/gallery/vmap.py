# %% [markdown]
# # Many parameters at once
#
# `prepare_images` computes on the host what depends on the data alone. What it returns is a pure
# function of the parameters, so `jax.vmap` maps it over as many as you like.

# %%
from importlib.resources import files

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxevent
from jaxevent import akf

packaged = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")
recording = jaxevent.events.crop(packaged[0.4:1.0], 60, 60, 60, 45)
given = recording.with_frames(slice(0, None, 2))  # frames 0, 2, 4, ...
hidden = recording.frames[1::2]  # the filter never sees these
truth = hidden.intensity
given, hidden

# %% [markdown]
# The error of each hidden image, as a function of the two contrast thresholds. Times are on the
# events' clock: the frames' stamps plus the clock offset.

# %%
offset = jaxevent.calibrate(given).clock_offset.value  # s, of the frames' stamps
times = hidden.t + round(1e6 * offset)
params = akf.Params(clock_offset=offset)
images = akf.prepare_images(given, times, params)


def errors(c_on, c_off):
    """Compute the mean squared error of every hidden image."""
    estimate = images(params.replace(c_on=c_on, c_off=c_off))
    return jnp.mean((estimate.mean.reshape(truth.shape) - truth) ** 2, axis=(1, 2))


thresholds = jnp.linspace(0.04, 0.16, 7)
over_off = jax.vmap(errors, in_axes=(None, 0))
grid = jax.jit(jax.vmap(over_off, in_axes=(0, None)))(thresholds, thresholds)
grid.shape  # c_on, c_off, hidden image

# %%
mean = np.asarray(grid.mean(axis=-1))
on, off = np.unravel_index(mean.argmin(), mean.shape)
spread = np.asarray(grid.std(axis=-1, ddof=1)) / np.sqrt(grid.shape[-1])
print(f"least MSE {mean[on, off]:.5f} +- {spread[on, off]:.5f} (standard error)")
print(f"at c_on = {thresholds[on]:.2f}, c_off = {thresholds[off]:.2f}")

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
shown = axes[0].pcolormesh(thresholds, thresholds, 1e2 * mean.T, cmap="viridis")
axes[0].plot(thresholds[on], thresholds[off], "r*", markersize=14, label="least error")
axes[0].set(xlabel="c_on (ln I)", ylabel="c_off (ln I)")
axes[0].legend()
figure.colorbar(shown, label="MSE x 1e-2")
for name, values in {
    "c_on, c_off at its best": grid[:, off],
    "c_off, c_on at its best": grid[on],
}.items():
    centre, error = 1e2 * values.mean(-1), 1e2 * values.std(-1, ddof=1) / np.sqrt(len(hidden))
    axes[1].errorbar(thresholds, centre, yerr=error, capsize=3, label=name)
axes[1].set(xlabel="threshold (ln I)", ylabel="MSE x 1e-2, with its standard error")
axes[1].legend()

# %% [markdown]
# A gradient finds the same minimum with fewer evaluations: [Fit noise parameters](fit_noise.md).
