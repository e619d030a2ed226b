# %% [markdown]
# # An estimator of your own
#
# Any function of a recording and times is a method for `evaluate`. Times are (T,), int64 us: the
# stamps of hidden frames, to which the function adds the offset of the clocks itself, as to those
# of the frames that it gets. It returns images (T, height, width) of intensity, 0 black and 1
# white, or a tuple of them and their variance of the same shape. This one adds the events since the
# last frame to it.

# %%
import dataclasses
from importlib.resources import files

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxevent
from jaxevent import akf
from jaxevent.reconstruction.filtering import Event, Observation

packaged = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")
recording = jaxevent.events.crop(packaged[0.6:0.9], 70, 90, 60, 45)


# %%
def integrate(recording, times):
    params = akf.Params.for_recording(recording)  # clock and thresholds
    frames, events = recording.frames, recording.events
    offset = round(1e6 * float(params.clock_offset))  # us, from stamps to the events' clock
    stamps, times = frames.t + offset, times + offset
    steps = np.where(events.p, params.c_on, -params.c_off)  # of ln(I + I0)
    pixel = events.y.astype(int) * recording.width + events.x
    size = recording.height * recording.width
    images = []
    for time in times:
        k = max(np.searchsorted(stamps, time) - 1, 0)
        part = slice(*np.searchsorted(events.t, [stamps[k], time]))
        change = np.bincount(pixel[part], steps[part], size).reshape(recording.height, -1)
        images.append((frames.intensity[k] + params.I0) * np.exp(change) - params.I0)
    return np.stack(images)


jaxevent.evaluate(recording, [integrate, "last-frame", "blend"]).means()[["mse", "ssim"]]

# %% [markdown]
# A per-pixel filter consists of a few pure functions of one pixel. Replace one of them, and the
# result takes part in evaluations, fits and commands like the methods of the package. It compiles
# to a kernel as well. Here is the AKF with a state that is drawn to the frames twice as fast.


# %%
def predict(params, state, dt, frame):
    """Predict over twice the time, so that the frames count twice as much."""
    return akf.predict(params, state, 2 * dt, frame)


forgetful = dataclasses.replace(akf, name="forgetful", predict=predict)
scores = jaxevent.evaluate(recording, [integrate, "blend", akf, forgetful])
scores.means()[["mse", "ssim"]]

# %% [markdown]
# To look inside, run the steps of one pixel with `jax.lax.scan`. The state is the log intensity L
# and its variance P.

# %%
events = recording.events
counts = np.bincount(events.y.astype(int) * recording.width + events.x, minlength=60 * 45)
y, x = divmod(int(counts.argmax()), recording.width)
here = (events.x == x) & (events.y == y)
seconds = (events.t[here] - events.t[0]) * 1e-6
since = jnp.asarray(np.diff(seconds, prepend=0.0))  # s since the pixel's previous event
polarity = jnp.where(events.p[here], 1, -1)
params = akf.Params.for_recording(recording)
level = jnp.log(recording.frames[:1].intensity[0, y, x] + params.I0)
frame = Observation(level, jnp.asarray(20.0))  # the first frame, at an information rate of 20 / s


def trajectory(method):
    """Run a filter over the pixel's events."""

    def step(state, event):
        since, polarity = event
        state = method.step(params, state, Event(since, since, polarity, frame))
        return state, method.readout(params, state)

    return jax.lax.scan(step, method.init(params, level), (since, polarity))[1]


figure, axis = plt.subplots(figsize=(9, 3.6), layout="constrained")
for name, method in {"akf": akf, "forgetful": forgetful}.items():
    L, P = trajectory(method)
    (line,) = axis.step(1e3 * seconds, L, where="post", label=name)
    axis.fill_between(
        1e3 * seconds, L - 2 * np.sqrt(P), L + 2 * np.sqrt(P), step="post", alpha=0.2,
        color=line.get_color(), label="2 standard deviations",
    )  # fmt: skip
axis.set(xlabel="time (ms)", ylabel="ln(I + I0)", title=f"pixel x = {x}, y = {y}")
axis.legend(ncols=2, loc="upper left", bbox_to_anchor=(1, 1))

# %% [markdown]
# Trackers, motion models and methods with parameters of their own: [Extending](../extending.md).
