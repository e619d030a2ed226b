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
table.assign(speed=np.hypot(table["vx"], table["vy"])).groupby("id").agg(
    start=("t", "min"), stop=("t", "max"), rows=("t", "size"), speed=("speed", "mean")
)  # px/s

# %% [markdown]
# Speed is not in the table, since its deviation needs the covariance of both components. Rows at
# close times share their error, so the mean over a track is not much better known than one row.

# %%
mean, covariance, valid = tracks([0.03])
velocity, C = mean[0, 0, 2:4], covariance[0, 0, 2:4, 2:4]
speed = np.hypot(*velocity)
print(f"{speed:.0f} +- {np.sqrt(velocity @ C @ velocity) / speed:.0f} px/s at 0.03 s")

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
# A blob that grows comes nearer. `blob.quantities.inverse_ttc_from_size` gives the inverse of its
# time to contact, which is defined at rest, and its variance. `inverse_ttc` compares two blobs at
# one depth, and `size_range` gives the range of one of known size. This blob comes from 17 m at
# 8 m/s. Given `Q_lambda`, `inverse_ttc_from_size` undoes the lag of filtered sizes and knows how
# long their errors last; for a smoothed track give `smoothed=True`, too.

# %%
scene, _ = jaxevent.simulate.blob_scene("growing", seed=100, rate=20_000)
near = jaxevent.blob.moment.estimate(scene[:1.2], smooth=False)
times = np.arange(0.1, 1.2, 0.01)
mean, covariance, valid = near(times)
inverse, variance = jaxevent.blob.quantities.inverse_ttc_from_size(
    times, mean[:, 0], covariance[:, 0], valid[:, 0], Q_lambda=near.params.Q_lambda
)
grown = near.to_dataframe(times, ids=near.id[:1])
grown = grown.assign(inverse_ttc=inverse, sigma_inverse_ttc=np.sqrt(variance))
grown = grown.assign(true_inverse=8 / (17 - 8 * times))
grown[["t", "inverse_ttc", "sigma_inverse_ttc", "true_inverse"]].tail()

# %% [markdown]
# The time to contact is the inverse, with the deviation $\sigma_g / g^2$ to first order, where the
# inverse is some deviations above zero. Rows at close times share their error.

# %%
g, sigma_g = grown["inverse_ttc"], grown["sigma_inverse_ttc"]
grown = grown.assign(ttc=1 / g, sigma_ttc=sigma_g / g**2, true_ttc=1 / grown["true_inverse"])
grown[["t", "ttc", "sigma_ttc", "true_ttc"]].tail()

# %% [markdown]
# States at other times: `tracks([0.02, 0.03])` returns mean, covariance and validity. On the
# command line: `jaxevent track recording.h5 --out tracked`.
