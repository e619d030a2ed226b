# %% [markdown]
# # Video from events alone
#
# `events-only` estimates the motion from the events, then the image that explains all events of a
# window along it ([theory](../theory/events_only.md)). Nothing is learned from images, and no frame
# is used: the frames of this recording only serve to score the result.

# %%
from importlib.resources import files

import matplotlib.pyplot as plt
import numpy as np

import jaxevent

packaged = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")
recording = jaxevent.events.crop(packaged[0.6:1.0], 60, 40, 120, 90)
alone = recording.with_frames(slice(0, 0))
frames = recording.frames[5:10]
frames

# %%
video = jaxevent.events_only.estimate(alone)
estimates = {
    "high-pass filter": jaxevent.high_pass.estimate(alone)(frames.t),
    "events-only": video(frames.t),
}


# %% [markdown]
# Events do not determine brightness and contrast. So each image is fitted to the frame by one
# factor and one offset in the logarithm before the two are compared.


# %%
def fit_to(frame, image):
    """Fit a log image to a frame by factor and offset; returns it with the error's RMS."""
    wanted, given = np.log(frame + 0.1), np.log(np.clip(image, 1e-3, None))
    slope, offset = np.polyfit(given.ravel(), wanted.ravel(), 1)
    fitted = np.exp(slope * given + offset) - 0.1
    return fitted, np.sqrt(np.mean((fitted - frame) ** 2))


fitted = {
    name: [fit_to(frame, image) for frame, image in zip(frames.intensity, e.mean, strict=True)]
    for name, e in estimates.items()
}
constant = frames.intensity.std(axis=(1, 2))
print(f"{'constant image':17} RMSE {constant.mean():.3f} +- {constant.std(ddof=1):.3f}")
for name, pairs in fitted.items():
    errors = np.array([error for _, error in pairs])
    print(f"{name:17} RMSE {errors.mean():.3f} +- {errors.std(ddof=1):.3f}")

# %%
k = 2
panels = {name: pairs[k][0] for name, pairs in fitted.items()}
panels["frame, not used"] = frames.intensity[k]
deviation = np.sqrt(estimates["events-only"].covariance[k])
figure, axes = plt.subplots(1, 4, figsize=(12, 2.7), layout="constrained")
for axis, (name, image) in zip(axes[:3], panels.items(), strict=True):
    axis.imshow(image, cmap="gray", vmin=0, vmax=frames.intensity[k].max())
    axis.set(title=name, xticks=[], yticks=[])
shown = axes[3].imshow(deviation, cmap="viridis")
axes[3].set(title="standard deviation", xticks=[], yticks=[])
figure.colorbar(shown, ax=axes[3], label="ln intensity")

# %% [markdown]
# The standard deviation is small at edges that the motion crosses, and large where nothing has been
# seen yet. It is that of ln(intensity) at the image's own contrast, which the thresholds set.
# Pixels that are known well enough are those with `valid` and a small deviation:

# %%
known = estimates["events-only"].valid & (estimates["events-only"].covariance < 0.2**2)
well = np.where(known, estimates["events-only"].mean, np.nan)
print(f"{100 * known[k].mean():.0f} % of the pixels are known to 0.2 in ln(intensity)")

# %% [markdown]
# A video of any rate, in which what is uncertain fades to grey. It needs the extra `video`; a
# folder gets PNG images.

# %%
jaxevent.show.save_video(video, np.arange(0.7, 0.8, 0.02), "alone")
