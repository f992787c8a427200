# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # From a run to plots of your own
#
# `livedeform run` leaves `run.mcap` with everything that was measured and predicted. Here it is read, and drawn.
#
# Name your run's folder in `RUN` (or in the environment variable of that name). Without one a recording of the shipped
# block stands in: its error is then that of a model that does not move.

# %%
import os
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a file, no window; leave it out in a notebook
import matplotlib.pyplot as plt
import numpy as np

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.compare_node.metrics import run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.shipped import CUBOID, shipped

RUN = os.environ.get("RUN", "")

# %% [markdown]
# ## Read
# One `Residual` per compared moment: ids (n,), measured and predicted places (n, 3) in metres.

# %%
if RUN:
    recording = load_recording(Path(RUN) / "run.mcap")
    residuals = [
        Residual(f.stamp_ns, f.ids, f.measured, f.measured - f.errors, np.full((len(f.ids), 3, 3), np.nan))
        for f in recording.errors
    ]
else:
    folder = shipped(CUBOID)
    recording = load_recording(folder / "bags" / "b")
    known = load_experiment(folder / "experiment").markers
    place = dict(zip(known.ids.tolist(), known.points, strict=True))
    residuals = [
        Residual(f.stamp_ns, f.ids, f.points, np.array([place[int(i)] for i in f.ids]), f.covariances)
        for f in recording.marker_frames
    ]
seconds = np.array([(r.stamp_ns - recording.start_ns) * 1e-9 for r in residuals])
print(len(residuals), "moments,", sum(len(r.ids) for r in residuals), "errors")

# %% [markdown]
# ## The numbers of the report
# The interval knows that frames which follow each other are not independent.

# %%
metrics = run_metrics(residuals, threshold=0.001)
print(f"rmse {1e3 * metrics.rmse.value:.3f} mm, 95 %: {1e3 * metrics.rmse.low:.3f} to {1e3 * metrics.rmse.high:.3f}")
print(f"{metrics.n_frames} frames are worth {metrics.n_effective:.1f} independent ones")

# %% [markdown]
# ## The error's direction, over time and marker by marker
# An error that points one way everywhere is a shift; one that points away from the probe is a stiffness.

# %%
fig, (over_time, directions) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
mean = 1e3 * np.array([r.errors.mean(axis=0) for r in residuals])
for axis, name in enumerate("xyz"):
    over_time.plot(seconds, mean[:, axis], label=name)
over_time.set(xlabel="time (s)", ylabel="mean error (mm)", title="where to")
over_time.legend()
worst = residuals[int(np.argmax([np.sqrt((r.distances**2).mean()) for r in residuals]))]
x, z = 1e3 * worst.predicted[:, 0], 1e3 * worst.predicted[:, 2]
directions.quiver(x, z, 1e3 * worst.errors[:, 0], 1e3 * worst.errors[:, 2], angles="xy", scale_units="xy", scale=0.5)
directions.plot(x, z, ".")
directions.set(xlabel="x (mm)", ylabel="z (mm)", title="worst moment, twice as long", aspect="equal")
fig.savefig("errors.png", dpi=120)
print("errors.png")

# %% [markdown]
# What must be true:

# %%
assert metrics.rmse.low <= metrics.rmse.value <= metrics.rmse.high
assert np.isclose(metrics.rmse.value, np.sqrt(np.mean(np.concatenate([r.distances for r in residuals]) ** 2)))
assert metrics.n_effective <= metrics.n_frames
