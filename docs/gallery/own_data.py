# %% [markdown]
# # Your own data
#
# Events are four columns of one length, sorted by time. Frames are images and a time for each.
# Arrays of NumPy, pandas, polars, PyTorch or JAX go in as they are. Here a moving disc stands for
# your own recording.

# %%
import matplotlib.pyplot as plt
import numpy as np

import jaxevent

disc, _ = jaxevent.simulate.blob_scene("disc", seed=1)
t, x, y, p = (np.asarray(getattr(disc.events[:20_000], name)) for name in "txyp")
t[:3], x[:3], y[:3], p[:3]  # us, column, row, ON

# %% [markdown]
# Integer times are microseconds. Floats need a unit, because seconds and milliseconds look alike.
# A unit that does not suit the events brings a warning.

# %%
recording = jaxevent.Recording.from_arrays(
    t * 1e-6, x, y, p, width=disc.width, height=disc.height, time_unit="s", name="disc"
)
recording

# %% [markdown]
# Input that is wrong or ambiguous is refused with one sentence that names the argument and the
# remedy.

# %%
for changed in ({"x": x + 1000}, {"t": t[::-1]}, {"p": np.where(p, 255, 0)}):
    columns = {"t": t, "x": x, "y": y, "p": p, **changed}
    try:
        jaxevent.Recording.from_arrays(**columns, width=disc.width, height=disc.height)
    except jaxevent.InputError as error:
        print("InputError:", error)

# %% [markdown]
# Frames are uint8, whose white is 255, uint16, whose white is 65535, or floats, whose white is 1.
# Cameras of 10 or 12 bits store lower levels as uint16: give `white=1023` or `white=4095`. Without
# it a warning says so.

# %%
levels = np.full((2, disc.height, disc.width), 2048, np.uint16)  # of 12 bits
grey = jaxevent.Recording.from_arrays(t, x, y, p, frames=levels, frame_times=t[[0, -1]], white=4095)
grey.frames.intensity.mean()

# %% [markdown]
# A structured array, a DataFrame or a dictionary of the four columns does as well.

# %%
table = recording.events.to_dataframe()
again = jaxevent.Recording.from_arrays(table, width=disc.width, height=disc.height, time_unit="us")
np.array_equal(again.events.t, recording.events.t), table.head(3)

# %% [markdown]
# Is the content right, too? `check_consistency` looks for faults such as hot pixels, missing
# events, inverted polarity and clocks that disagree. Each comes with its remedy; check again after
# it.

# %%
jaxevent.check_consistency(recording)

# %% [markdown]
# Count the events of each pixel, and their rate over time with its standard deviation (Poisson).

# %%
counts = jaxevent.events.count_events(recording)
rate, edges = np.histogram(recording.events.t * 1e-3, bins=40)
width_ms = edges[1] - edges[0]
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
shown = axes[0].imshow(np.asarray(counts), cmap="magma")
figure.colorbar(shown, label="events per pixel")
axes[0].set(xlabel="x (px)", ylabel="y (px)")
middle = (edges[1:] + edges[:-1]) / 2
axes[1].plot(middle, rate / width_ms, label="rate")
band = np.sqrt(rate) / width_ms
axes[1].fill_between(
    middle, rate / width_ms - band, rate / width_ms + band, alpha=0.3, label="1 standard deviation"
)
axes[1].set(xlabel="time (ms)", ylabel="events per ms", ylim=(0, None))
axes[1].legend()

# %% [markdown]
# `jaxevent.save(recording, "mine.h5")` writes a file for the command line. Files of most cameras
# are [read](../formats.md) by `jaxevent.load`.
