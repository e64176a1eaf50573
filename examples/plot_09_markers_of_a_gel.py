"""
Markers of a GelSight-like gel
==============================

Where the dots of a gel are, and how far each has moved, needs no network. This gel is simulated: flat, with a grid of
dots, lit from three sides. A video, a folder of images or a data set goes in the same way.
"""

import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl
from sliplens.markers import interpolate_field
from sliplens.plots.markers import plot_arrows, plot_field

data = sl.simulate(sensor="flat-gel", dry_trials=4, wet_trials=1, days=4, frames_per_trial=40)
trial = data.load(data.trials[0])

# %%
# One row for each marker of each frame; what is not known is null, never a guess.
tracking = sl.track(trial.frames, reference=trial.reference, markers="auto")
table = tracking.frame()
status, counts = np.unique(table["status"].to_numpy(zero_copy_only=False), return_counts=True)
print(dict(zip(status.tolist(), counts.tolist(), strict=True)))

# %%
# Half-way through the pull: arrows from where each dot rests, and the field between them. Grey is a guess.
number = 26
rows = table.filter(np.asarray(table["frame"]) == number)
rest, moved = (
    np.column_stack([rows[name].to_numpy(zero_copy_only=False).astype(float) for name in names])
    for names in (("rest_x_px", "rest_y_px"), ("dx_px", "dy_px"))
)
known = np.isfinite(moved).all(axis=1) & np.isfinite(rest).all(axis=1)
field = interpolate_field(rest[known], moved[known], size=trial.reference.shape[:2])

figure, (left, right) = plt.subplots(ncols=2, figsize=(10, 4.6), layout="compressed")
plot_arrows(trial.frames[number], rest, moved, ax=left)
left.set_title("each dot, from where it rests")
scale = plot_field(field, size=trial.reference.shape[:2], ax=right)
figure.colorbar(scale, ax=right, label="Displacement (px)")
right.set_title("the field between them")
plt.show()

# %%
# :doc:`/markers` tells what the margin is that model-based estimators read from such a field, beside a network's.
