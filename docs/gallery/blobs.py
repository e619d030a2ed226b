# %% [markdown]
# # Blobs to a DataFrame
#
# Trackers find targets in events alone and follow each with an extended Kalman filter. Their tables
# hold position, velocity, size and orientation with standard deviations. Here the truth is known.

# %%
import matplotlib.pyplot as plt
import numpy as np

import jaxevent

scene, truth = jaxevent.simulate.blob_scene("lissajous", seed=100)
recording = scene[:0.06]
recording

# %%
tracks = jaxevent.blob.moment.estimate(recording)  # finds the targets and their parameters
table = tracks.to_dataframe()
table.head()

# %% [markdown]
# The table is an ordinary DataFrame: group it, select from it, save it.

# %%
table.groupby("id").agg(
    start=("t", "min"),
    stop=("t", "max"),
    rows=("t", "size"),
    speed=("vx", lambda v: v.abs().mean()),
)

# %% [markdown]
# Compare with the truth. If the reported deviations are right, errors divided by them have a root
# mean square of about 1.

# %%
true = truth((table["t"].to_numpy() * 1e6).round().astype(np.int64))[:, 0, :2]
for axis_name, values in zip("xy", true.T, strict=True):
    error = table[axis_name] - values
    ratio = np.sqrt(np.mean((error / table[f"sigma_{axis_name}"]) ** 2))
    print(f"{axis_name}: error {error.mean():+.2f} +- {error.std():.2f} px; "
          f"{ratio:.2f} reported standard deviations")  # fmt: skip

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
axes[0].plot(*true.T, "k", label="truth")
axes[0].plot(table["x"], table["y"], "C0--", label="moment")
axes[0].set(xlabel="x (px)", ylabel="y (px)", aspect="equal")
axes[0].invert_yaxis()
axes[0].legend()
time_ms, error = 1e3 * table["t"], table["x"] - true[:, 0]
axes[1].plot(time_ms, error, label="error of x")
axes[1].fill_between(
    time_ms, -2 * table["sigma_x"], 2 * table["sigma_x"], alpha=0.3, label="2 standard deviations"
)
axes[1].set(xlabel="time (ms)", ylabel="px")
axes[1].legend()

# %% [markdown]
# States at other times: `tracks([0.02, 0.03])` returns mean, covariance and validity. On the
# command line: `jaxevent track recording.h5 --out tracked`.
