"""
Test maps against redrawn scenes
================================

Measure the effect of each marker without a map, and compare maps with it. In simulation a marker is moved back to its
rest position, and the frame is drawn and predicted again. A correct map ranks the markers by these effects.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import spearmanr

import sliplens as sl
from sliplens.explainers.table import get_explainer
from sliplens.simulation import PRESETS, plan_trials
from sliplens.simulation.trials import prepare_trial, put_markers_back, simulate_trial, visible_markers

# %%
# A trial, and the scene from which any frame can be drawn again with some markers at rest.
plan = replace(plan_trials(PRESETS["thesis"])[0], frames=60)
trial = simulate_trial(plan)
_, film = prepare_trial(plan)
number = 36
frame, network = trial.frames[number], sl.load("thesis-difference")

# %%
# Move each marker back alone, and predict.
markers = visible_markers(film.sensor)
back = np.zeros((1 + len(markers), len(film.marker_rest_px)), dtype=bool)
back[1 + np.arange(len(markers)), markers] = True
drawn = put_markers_back(film, number, back).draw_all()
predictions = network.predict(network.encode(drawn, trial.reference)).numpy()
effects = predictions[0] - predictions[1:]
print(
    f"true margin {trial.safety_margin[number]:.2f}, predicted {predictions[0]:.2f}; one marker changes it by up to "
    f"{np.abs(effects).max():.3f}"
)

# %%
# The same markers in three maps: the mean of the map in a disc around each.
methods = {
    "occlusion": {"tile_px": 7},
    "integrated-gradients": {"steps": 20},
    "grad-cam-thesis": {},
}
size = network.manifest.image_size
places = film.marker_px[number][markers] * size / frame.shape[0]
y, x = np.mgrid[:size, :size]
near = np.hypot(x - places[:, 0, None, None], y - places[:, 1, None, None]) < 4
values_of = {}
for method, options in methods.items():
    explainer = get_explainer(method, **options)
    explanation = sl.explain(network, frame[None], reference=trial.reference, method=explainer)
    [relevance] = explanation.relevance[explanation.method]
    values_of[method] = np.array([relevance[disc].mean() for disc in near])

# %%
figure, axes = plt.subplots(ncols=4, figsize=(13, 3.8), layout="compressed")
axes[0].imshow(frame)
top = np.abs(effects).max()
dots = axes[0].scatter(
    *film.marker_px[number][markers].T, c=effects, cmap="PuOr", vmin=-top, vmax=top, s=50, edgecolor="k"
)
axes[0].set(title="effect of each marker", xticks=[], yticks=[])
figure.colorbar(dots, ax=axes[0], label="margin units", location="bottom")
for ax, (method, values) in zip(axes[1:], values_of.items(), strict=True):
    ax.scatter(effects, 1e3 * values, color="#0072B2", s=18)
    ax.axhline(0, color="grey", linewidth=0.8)
    ax.axvline(0, color="grey", linewidth=0.8)
    rank = spearmanr(effects, values).statistic
    ax.set(title=f"{method}\nrank correlation {rank:.2f}", xlabel="Effect of the marker (margin units)")
axes[1].set_ylabel("Map (thousandths a pixel)")
plt.show()

# %%
# One frame only shows how the test works. A :doc:`/study` tests many frames, with groups of markers, controls that use
# nothing of the network, and intervals.
