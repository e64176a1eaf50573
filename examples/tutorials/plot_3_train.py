"""
Train a network for your sensor
===============================

A network that was trained on another sensor is often wrong on yours. Ten labelled trials and some minutes adapt it:
``sliplens train DATA -o RUN --recipe adapt --start-from chromatouch-pair``.
Here three epochs on small images show the steps within a minute; their accuracy is not that of a whole training.
"""

import matplotlib.pyplot as plt

import sliplens as sl

# %%
# The data
# --------
# `import_recordings` makes a data set of your videos and force tables (tutorial 1). Record trials up to the slip, on
# several days: the last day is the test, the one before it validates. This simulated sensor is a flat gel with three
# lights.
data = sl.simulate(sensor="flat-gel", dry_trials=12, wet_trials=2, days=4, frames_per_trial=24)
print(f"{len(data.trials)} trials of {len({trial.day for trial in data.trials})} days")

# %%
# Measure the included network first
# ----------------------------------
before = sl.evaluate("chromatouch-pair", data)

# %%
# Adapt it
# --------
# Only `recipe` and `start_from` are needed; the other arguments make this page short.
network = sl.train(
    data, recipe="adapt", start_from="chromatouch-pair", image_size=96, epochs=3, epoch_frames=160, batch_size=16
)
after = sl.evaluate(network, data)

# %%
# Compare on the held-out day
# ---------------------------
figure, axes = plt.subplots(ncols=2, figsize=(10, 4), layout="constrained")
for ax, evaluation, title in zip(axes, (before, after), ("unchanged", "adapted for three epochs"), strict=True):
    sl.plot(evaluation, ax)
    ax.set_title(title, loc="left")
plt.show()

# %%
# How far to trust it: two trials a day and three epochs only show the steps. With the whole recipe, ten dry trials
# reached R2 0.79 to 0.89 on three other simulated sensors; dry trials do not train wet objects (:doc:`/networks`).
