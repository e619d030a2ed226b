# %% [markdown]
# # Egomotion against a gyro
#
# A camera that only turns determines its rotation from events and its calibration. A gyroscope in
# the same housing is the reference. Both are simulated here: the gyro has noise and an unknown
# bias.

# %%
import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import jaxevent
from jaxevent import egomotion
from jaxevent.recording import Imu

recording, camera = jaxevent.simulate.motion_scene(
    "rotation", "varying", seed=100, size=(120, 90), focal=100.0, duration=0.3
)
rng = np.random.default_rng(100)
t = np.arange(0, 300_000, 1000)  # us, 1 kHz
true = np.asarray(camera.twist(t)[1])  # rad/s
BIAS = np.array([0.03, -0.02, 0.05])
gyro = true + BIAS + rng.normal(0, 0.05, true.shape)
recording = dataclasses.replace(recording, imu=Imu(t, gyro))
recording

# %% [markdown]
# `planes` fits the normal flow of events and is the fastest. `contrast` and `voting` are called in
# the same way, and are more accurate on larger sensors. `voting` finds the motion first, here in
# about 0.1 s: until then `valid` is false.

# %%
motion = egomotion.planes.estimate(recording, model="rotation")
times = np.arange(0.05, 0.25, 0.01)  # s
omega, covariance, valid = motion(times)
motion

# %% [markdown]
# The gyro's bias is the mean difference of the two, as far as the estimate has no offset of its
# own. A recording cannot tell them apart. In this simulation the truth can.

# %%
measured = np.stack([np.interp(times, t * 1e-6, column) for column in gyro.T], axis=1)
truth = np.stack([np.interp(times, t * 1e-6, column) for column in true.T], axis=1)
bias = np.mean(measured - omega, axis=0)
names = ["about x", "about y", "about z"]
for k, name in enumerate(names):
    error = omega[:, k] - truth[:, k]
    print(f"{name}: gyro less estimate {bias[k]:+.3f} rad/s; bias {BIAS[k]:+.3f}, the estimate's "
          f"error {error.mean():+.3f} +- {error.std(ddof=1):.3f} rad/s")  # fmt: skip


def relative_error(reference):
    return np.median(np.linalg.norm(omega - reference, axis=1) / np.linalg.norm(truth, axis=1))


print(f"median error: {100 * relative_error(truth):.1f} % of the true rotation, "
      f"{100 * relative_error(measured - bias):.1f} % beside the gyro less its bias")  # fmt: skip

# %%
deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
figure, axis = plt.subplots(figsize=(9, 4), layout="constrained")
for k, name in enumerate(names):
    axis.plot(t * 1e-6, gyro[:, k] - bias[k], color=f"C{k}", linewidth=0.5, alpha=0.5)
    axis.plot(times, omega[:, k], color=f"C{k}", label=name)
    axis.fill_between(
        times, omega[:, k] - 2 * deviation[:, k], omega[:, k] + 2 * deviation[:, k],
        color=f"C{k}", alpha=0.25,
    )  # fmt: skip
axis.plot([], [], "grey", linewidth=0.5, label="gyro without its bias")
axis.fill_between([], [], color="grey", alpha=0.25, label="2 standard deviations")
axis.set(xlabel="time (s)", ylabel="angular velocity (rad/s)")
axis.legend(ncols=2)

# %% [markdown]
# `known_motion` takes the truth from a recording's poses or gyro. `plot_motion` draws the errors
# against it.

# %%
by_poses = egomotion.known_motion(recording, "rotation", "poses")
jaxevent.show.plot_motion(motion, times, by_poses)

# %% [markdown]
# A gyro may have axes of its own. `plot_motion` then warns, as `score_motion` does, and
# `find_gyro_axes` names those in which gyro and estimate agree. jAER's have y upwards:

# %%
turned = dataclasses.replace(
    recording, imu=Imu(t, gyro * [1, -1, -1], np.zeros_like(gyro)), poses=None
)
by_gyro = egomotion.known_motion(turned, "rotation")
axes = egomotion.scores.find_gyro_axes(motion, by_gyro)
by_gyro = egomotion.known_motion(turned, "rotation", bias=bias * [1, -1, -1], rotation=axes)
print(axes, np.abs(omega - by_gyro(times)).mean(0))  # rad/s

# %% [markdown]
# A recording without a calibration gets one as `jaxevent.load(path, camera=lens)`, or later:

# %%
lens = jaxevent.camera.PinholeCamera(fx=100.0, fy=100.0, cx=59.5, cy=44.5)  # px
dataclasses.replace(turned, camera=lens)

# %% [markdown]
# On the command line `jaxevent motion recording.h5 --model rotation --truth` compares with the
# recording's gyro, and `--imu-rotation` names its axes.
