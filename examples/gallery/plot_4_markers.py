"""
Markers of a GelSight-like gel
==============================

Detect and track the dots of a gel; no network is needed. This gel is simulated: flat, with a grid of dots and three
lights. `track` takes a video, a folder of images or a data set too; :doc:`/markers` has its accuracy on real clips.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import griddata

import sliplens as sl

data = sl.simulate(sensor="flat-gel", dry_trials=4, wet_trials=1, days=4, frames_per_trial=40)
trial = data.load(data.trials[0])

# %%
# The table has one row per marker and frame; unknown positions are null.
tracking = sl.track(trial.frames, reference=trial.reference, markers="auto")
table = tracking.to_arrow()
status, counts = np.unique(table["status"].to_numpy(zero_copy_only=False), return_counts=True)
print(dict(zip(status.tolist(), counts.tolist(), strict=True)))

# %%
# One frame during the pull: displacement of each dot, and the field between them; it is unknown where it is grey.
number = 26
rows = table.filter(np.asarray(table["frame"]) == number)
rest, moved = (
    np.column_stack([rows[name].to_numpy(zero_copy_only=False).astype(float) for name in names])
    for names in (("rest_x_px", "rest_y_px"), ("dx_px", "dy_px"))
)
measured = np.isfinite(moved).all(axis=1) & np.isfinite(rest).all(axis=1)
height, width = trial.reference.shape[:2]
x, y = np.meshgrid(np.arange(4, width, 8), np.arange(4, height, 8))
field = griddata(rest[measured], moved[measured], (x, y))

figure, (left, right) = plt.subplots(ncols=2, figsize=(10, 4.6), layout="compressed")
left.imshow(trial.frames[number])
left.quiver(*rest[measured].T, *moved[measured].T, angles="xy", scale_units="xy", scale=0.2, color="white")
left.set(title="displacement of each dot, five times its length", xlabel="x (px)", ylabel="y (px)")
right.set_facecolor("lightgrey")
scale = right.pcolormesh(x, y, np.linalg.norm(field, axis=-1), cmap="cividis")
right.streamplot(x, y, *np.moveaxis(field, -1, 0), color="white", density=0.8)
figure.colorbar(scale, ax=right, label="Displacement (px)")
right.set(title="interpolated field", xlabel="x (px)", ylabel="y (px)", aspect="equal")
right.invert_yaxis()
plt.show()

# %%
# :doc:`/markers` computes traction from such a field, also on a real dome.
