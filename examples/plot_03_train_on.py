"""
Train on from a network of the package
======================================

A sensor of your own is read best by a network that saw it. Start from one that comes with the package: a few labelled
trials, on several days and each to the slip, change it in minutes. Here the images are small and the epochs short, so
that the page builds in seconds; :doc:`/networks` tells what ten trials reach with the whole recipe.
"""

import matplotlib.pyplot as plt

import sliplens as sl

# %%
# Another sensor than the networks know: a flat gel, lit from three sides. The last day tests, the one before
# validates.
data = sl.simulate(sensor="flat-gel", dry_trials=12, wet_trials=2, days=4, frames_per_trial=24)
before = sl.evaluate("chromatouch-pair", data)

# %%
# The recipe ``adapt`` is made for a few trials of your own. Leave out what follows it: those shorten it.
network = sl.train(
    data, recipe="adapt", start_from="chromatouch-pair", image_size=96, epochs=3, epoch_frames=160, batch_size=16
)
after = sl.evaluate(network, data)

# %%
# Read on trials of a day that neither training nor validation has seen. So few trials and steps show the way; they
# are no measure of what a network can learn.
figure, axes = plt.subplots(ncols=2, figsize=(10, 4), layout="constrained")
for ax, evaluation, title in zip(axes, (before, after), ("as it comes", "after three short epochs"), strict=True):
    sl.plot(evaluation, ax)
    ax.set_title(title, loc="left")
plt.show()
