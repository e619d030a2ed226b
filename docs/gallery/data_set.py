# %% [markdown]
# # A data set in batch
#
# `jaxevent.evaluate` scores any number of methods on any number of recordings, with frames that no
# method was given. A metric of your own is a function of two images.

# %%
from importlib.resources import files

import matplotlib.pyplot as plt
import numpy as np

import jaxevent
from jaxevent import akf

packaged = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")
corners = [(20, 20), (90, 20), (160, 20), (20, 110), (90, 110), (160, 110)]
recordings = {
    f"part_{k}": jaxevent.events.crop(packaged[0.6:0.9], left, top, 60, 50)
    for k, (left, top) in enumerate(corners)
}
list(recordings)


# %%
def edge_error(estimate, truth):
    """Mean difference of the horizontal gradients."""
    return np.abs(np.diff(estimate) - np.diff(truth)).mean()


scores = jaxevent.evaluate(recordings, ["last-frame", "blend", akf], metrics=["mse", edge_error])
scores.means()

# %% [markdown]
# One row for each recording and method.

# %%
table = scores.to_dataframe()
table[["recording", "method", "mse", "edge_error"]].head()

# %%
methods = list(dict.fromkeys(table["method"]))
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for axis, measure, label in zip(
    axes, ["mse", "edge_error"], ["MSE", "edge error (own metric)"], strict=True
):
    groups = [table.loc[table["method"] == name, measure].to_numpy() for name in methods]
    axis.boxplot(groups, tick_labels=methods)
    means, deviations = [g.mean() for g in groups], [g.std(ddof=1) for g in groups]
    axis.errorbar(
        range(1, len(groups) + 1), means, yerr=deviations, fmt="o", capsize=4,
        label="mean and standard deviation",
    )  # fmt: skip
    axis.set_ylabel(label)
    axis.legend()

# %% [markdown]
# Files go in by their names, `"recordings/*.h5"`. With `out="compared"` what is finished is kept in
# a folder, and an evaluation that was stopped goes on where it was. A Dask cluster shares out the
# work:
#
# ```python
# from distributed import Client
#
# with Client() as client:
#     jaxevent.evaluate("recordings/*.h5", ["blend", akf], cluster=client, out="compared")
# ```
#
# The same from a file of settings: [Fit and compare](../fitting.md#compare).
