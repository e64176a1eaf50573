"""
Maps of one frame by several methods
====================================

Compute maps of one frame by several methods. Each map explains the difference of the predicted margin from that of the
untouched sensor. Maps are signed and in margin units: orange lowers the margin, blue raises it. They disagree:
:doc:`plot_2_maps_against_redrawn_scenes` tests them.
"""

import matplotlib.pyplot as plt

import sliplens as sl
from sliplens.explainers.table import get_explainer

data = sl.simulate(dry_trials=4, wet_trials=1, days=4, frames_per_trial=40)
trial = data.load(data.trials[0])
frame = trial.frames[24:25]

# %%
# Coarse tiles and few steps make this page fast. ``budget=0.05`` measures 5 % of the channels of Poly-CAM, and
# ``likeness=None`` stops there. Leave both out for an accurate map.
options = {
    "grad-cam": {},
    "integrated-gradients": {"steps": 16},
    "smooth-grad": {},
    "occlusion": {"tile_px": 28},
    "shapley": {"tile_px": 28},
    "poly-cam": {"budget": 0.05, "likeness": None},
    "integrated-gradients-thesis": {},
    "grad-cam-thesis": {},
}
maps = {
    method: sl.explain(
        "chromatouch-difference", frame, reference=trial.reference, method=get_explainer(method, **chosen)
    )
    for method, chosen in options.items()
}

# %%
figure, axes = plt.subplots(2, 4, figsize=(11, 6.4), layout="compressed")
for ax, (method, explanation) in zip(axes.flat, maps.items(), strict=True):
    sl.plot(explanation, ax)
    ax.set_title(method, loc="left", fontsize=10)
plt.show()

# %%
# Each explanation has its warnings:
for method, explanation in maps.items():
    for notes in explanation.methods.values():
        for warning in notes.warnings:
            print(f"{method}: {warning}")
