# %% [markdown]
# # tonic and PyTorch, in and out
#
# Items of tonic's data sets are structured arrays with a target. `jaxevent.io.tonic` converts them
# to recordings and back. Tensors of PyTorch go in as columns, and results leave without a copy by
# DLPack.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxevent
import jaxevent.io.tonic

# %% [markdown]
# An item as `tonic.datasets.NMNIST` gives it: x, y, t (us) and p, and the digit.

# %%
dot, _ = jaxevent.simulate.blob_scene("disc", seed=3)
part = jaxevent.events.crop(dot[:0.03], 720, 180, 240, 240)
item = jaxevent.io.tonic.to_item(part, target=3)
item[0].dtype, item[0][:2], item[1]

# %%
recording = jaxevent.io.tonic.from_item(item, size=(240, 240, 2))
recording, recording.extra["target"]

# %% [markdown]
# With tonic installed (`pip install tonic`), its transforms take the same array.

# %%
try:
    import tonic
except ImportError:
    print("tonic is not installed here")
else:
    to_frame = tonic.transforms.ToFrame(sensor_size=(240, 240, 2), n_time_bins=3)
    print("frames of tonic:", to_frame(item[0]).shape)

# %% [markdown]
# A voxel grid for a network, and its spread over the pixels with events.

# %%
events = recording.events
grid = np.asarray(jaxevent.events.voxel_grid(recording, 5))
seen = np.abs(grid).sum(axis=0) > 0
means, deviations = grid[:, seen].mean(axis=1), grid[:, seen].std(axis=1)
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
limit = np.abs(grid).max()
shown = axes[0].imshow(grid[2], cmap="RdBu_r", vmin=-limit, vmax=limit)
axes[0].set(title="bin 2 of 5", xlabel="x (px)", ylabel="y (px)")
figure.colorbar(shown, label="ON minus OFF")
axes[1].errorbar(
    range(5), means, yerr=deviations, marker="o", capsize=4,
    label="mean and standard deviation",
)  # fmt: skip
axes[1].set(xlabel="bin", ylabel="events per pixel, ON minus OFF")
axes[1].legend()
# %% [markdown]
# PyTorch: tensors in, a tensor out that shares the memory of the JAX array.

# %%
try:
    import torch
except ImportError:
    print("PyTorch is not installed here")
else:
    arrays = {name: np.asarray(getattr(events, name)).astype(np.int64) for name in "txyp"}
    columns = {name: torch.asarray(array) for name, array in arrays.items()}
    again = jaxevent.Recording.from_arrays(columns, width=240, height=240, time_unit="us")
    image = jaxevent.high_pass.estimate(again)([0.02]).mean
    tensor = torch.from_dlpack(jnp.asarray(image))
    print("tensor:", tuple(tensor.shape), tensor.dtype)

# %% [markdown]
# A whole data set becomes recordings with `jaxevent.io.tonic.from_dataset`
# ([reference](../api/recordings.md)).
