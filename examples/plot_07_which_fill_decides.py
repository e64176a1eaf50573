"""
Which fill decides
==================

To test a map, the pixels that it calls most influential are taken away, and others in their place. What stands in
their place, the fill, can decide the test: with a fill that no sensor ever shows, the network answers to the fill.
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
# The same maps of the same two frames under three fills: the untouched sensor, a blur of the image, and grey as in
# the thesis.
fills = ("reference", "blur", "grey")
scores = {fill: sl.score(network, maps, fill=fill, unit="tile", random_orders=2, steps=0) for fill in fills}

# %%
# The gap between the dashed and the full line is the gain: how much more is lost where the map says "most" than where
# it says "least", in margin units. Dotted are random orders. Where the lines end is what the network answers to
# nothing but the fill: if that is far from where an untouched sensor is read, the fill itself was read.
figure, axes = plt.subplots(ncols=3, figsize=(12, 3.8), sharey=True, layout="constrained")
for ax, (fill, found) in zip(axes, scores.items(), strict=True):
    sl.plot(found, ax)
    ax.set_title(f"{fill}: gain {found.score(maps.method).srg.estimate:.2f}", loc="left")
    ax.get_legend().remove()
for ax in axes[1:]:
    ax.set_ylabel("")
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
plt.show()

# %%
# The score says where it may not measure the map at all, and shows maps that know nothing of the network beside it.
for fill, found in scores.items():
    for alarm in found.alarms:
        print(f"{fill}: {alarm}")
