# %% [markdown]
# # HDR video from frames and events
#
# A simulated camera pans over a scene whose bright parts exceed the frames' white many times.
# Frames clip; events do not. The asynchronous Kalman filter `akf` and the smoother `aks` combine
# both. The true intensity is known, so that errors can be measured.

# %%
import matplotlib.pyplot as plt
import numpy as np

from jaxevent import akf, aks, blend, simulate

panorama = simulate.scene("tunnel")
camera = simulate.Pan(panorama, speed="fast", size=(80, 60), duration=0.5)
recording = simulate.simulate(camera, seed=100)
truth, times = np.asarray(recording.extra["hdr"]), recording.extra["hdr_t"]
print(f"{len(recording.events):,} events, true intensity up to {truth.max():.0f}, white is 1")

# %% [markdown]
# `preset="hdr"` recognises clipped pixels and starts from a sensor of high dynamic range. Clock and
# thresholds are calibrated from the recording.

# %%
estimates = {"blend of frames": blend.estimate(recording, blend.Params())(times)}
for name, method in {"akf": akf, "aks": aks}.items():
    params = method.Params.for_recording(
        recording, preset="hdr", I0=float(recording.extra["dark_offset"])
    )
    estimates[name] = method.estimate(recording, params)(times)


# %% [markdown]
# Errors are measured in the logarithm, ln(I + 0.003), as the eye does. The table holds the mean
# over images and its standard deviation.


# %%
def log_error(image):
    difference = np.log(np.clip(image, 0, None) + 0.003) - np.log(truth + 0.003)
    return np.sqrt(np.mean(difference**2, axis=(1, 2)))


errors = {name: log_error(estimate.mean) for name, estimate in estimates.items()}
for name, values in errors.items():
    print(f"{name:16} log RMSE {values.mean():.3f} +- {values.std(ddof=1):.3f}")

# %%
k = int(np.argmax(truth.max(axis=(1, 2))))
panels = {"truth": truth[k], **{name: e.mean[k] for name, e in estimates.items()}}
figure, axes = plt.subplots(1, 4, figsize=(12, 2.8), layout="constrained")
for axis, (name, image) in zip(axes, panels.items(), strict=True):
    shown = axis.imshow(
        np.log10(np.clip(image, 0.003, None)), cmap="gray", vmin=-2.5, vmax=np.log10(truth[k].max())
    )
    axis.set(title=name, xticks=[], yticks=[])
figure.colorbar(shown, ax=axes, label="log10 of intensity")
# %% [markdown]
# Along the row through the brightest point, with the standard deviation that the smoother reports.
# A pixel that was never within the frames' range is known by its changes alone; there the deviation
# is too small.

# %%
row = int(np.argmax(truth[k].max(axis=1)))
mean, variance = estimates["aks"].mean[k, row], estimates["aks"].covariance[k, row]
level, deviation = np.log(np.clip(mean, 1e-3, None)), np.sqrt(variance)
figure, axis = plt.subplots(figsize=(9, 3.4), layout="constrained")
axis.plot(np.log(truth[k, row] + 1e-3), "k", label="truth")
axis.plot(
    np.log(np.clip(estimates["blend of frames"].mean[k, row], 1e-3, None)), "C1--", label="frames"
)
axis.plot(level, "C0", label="aks")
axis.fill_between(
    range(len(level)), level - 2 * deviation, level + 2 * deviation, alpha=0.3, color="C0",
    label="2 standard deviations",
)  # fmt: skip
axis.axhline(0, color="grey", linewidth=0.8, label="white of the frames")
axis.set(xlabel="x (px)", ylabel="ln intensity")
axis.legend(ncols=2)

# %% [markdown]
# `mc` has less error still ([results](../results/reconstruction.md#high-dynamic-range)), and is
# called in the same way. It is left out here because its first call compiles for about half a
# minute.
#
# To write a video, scale images for the display, all with the same limits:
#
# ```python
# from jaxevent.show.images import tone_map, video_writer
#
# images = estimates["aks"].mean
# with video_writer("video.mp4", fps=30) as write:
#     for image in images:
#         write(tone_map(image, "log", limits=(0.003, images.max())))
# ```
#
# On the command line: `jaxevent reconstruct mine.h5 --rate 200 --tone log --out video.mp4`. Which
# method suits which recording: [Which method when](../methods.md).
