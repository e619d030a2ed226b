# %% [markdown]
# # A data set in batch
#
# `jaxevent.evaluate` scores any number of methods on any number of recordings, with frames that no
# method was given. A metric of your own is a function of two images. A Dask cluster shares out the
# work.

# %%
from importlib.resources import files
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np
from distributed import Client

import jaxevent
from jaxevent import akf

folder = Path(mkdtemp())
packaged = jaxevent.load(files("jaxevent") / "data/slider_depth_crop.h5")
for k, (left, top) in enumerate([(20, 20), (90, 20), (160, 20), (20, 110), (90, 110), (160, 110)]):
    part = jaxevent.events.crop(packaged[0.6:0.9], left, top, 60, 50)
    jaxevent.save(part, folder / f"part_{k}.h5")
sorted(path.name for path in folder.glob("*.h5"))


# %%
def edge_error(estimate, truth):
    """Mean difference of the horizontal gradients."""
    return np.abs(np.diff(estimate) - np.diff(truth)).mean()


# %%
with Client(processes=False, threads_per_worker=2, dashboard_address=":0") as client:
    scores = jaxevent.evaluate(
        str(folder / "*.h5"),
        ["last-frame", "blend", akf],
        metrics=["mse", edge_error],
        cluster=client,
        out=folder / "compared",
    )
scores.means()

# %% [markdown]
# One row for each recording and method. What is finished is kept in the folder: an evaluation that
# was stopped goes on where it was.

# %%
table = scores.to_dataframe()
table["recording"] = [Path(name).stem for name in table["recording"]]
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
# The same from a file of settings, with many machines: [Fit and compare](../fitting.md#compare).
