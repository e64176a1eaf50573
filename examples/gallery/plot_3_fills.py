"""
Choose the fill of a removal test
=================================

Compare fills. A removal test replaces the pixels that a map ranks highest by a fill, and measures the change of the
prediction. If no sensor shows such a fill, the network responds to the fill instead of the removal.
"""

import matplotlib.pyplot as plt

import sliplens as sl
from sliplens.explainers.table import get_explainer

data = sl.simulate(dry_trials=4, wet_trials=1, days=4, frames_per_trial=40)
trial = data.load(data.trials[0])
frames, untouched = trial.frames[[22, 28]], trial.reference
network = sl.load("chromatouch-difference")
maps = sl.explain(network, frames, reference=untouched, method=get_explainer("occlusion", tile_px=28))

# %%
# The maps of two frames, tested with three fills: the untouched sensor, the blurred image, and grey as in the thesis.
fills = ("reference", "blur", "grey")
scores = {fill: sl.score(network, maps, fill=fill, unit="tile", random_orders=2, steps=0) for fill in fills}

# %%
# The gap between the dashed and the full line is the gain, in margin units: how much more the prediction changes when
# the highest pixels are removed first than when the lowest are. Dotted lines are random orders. All lines end at the
# prediction for the fill alone: if it is far from that for an untouched sensor, the fill itself changes the prediction.
figure, axes = plt.subplots(ncols=3, figsize=(12, 3.8), sharey=True, layout="constrained")
for ax, (fill, result) in zip(axes, scores.items(), strict=True):
    sl.plot(result, ax)
    ax.set_title(f"{fill}: gain {result.score(maps.method).srg.estimate:.2f}", loc="left")
    ax.get_legend().remove()
for ax in axes[1:]:
    ax.set_ylabel("")
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
plt.show()

# %%
# Alarms name the cases in which a score may not measure the map at all.
for fill, result in scores.items():
    for alarm in result.alarms:
        print(f"{fill}: {alarm}")
