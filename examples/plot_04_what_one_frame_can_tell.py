"""
What one frame can tell
=======================

A frame shows how far the skin is sheared, and that is the tangential over the normal force. What the friction could
hold hardly shows. So most of what is uncertain about a margin is gone once the friction is told: a number, a range,
or what an earlier slip of the object has taught.
"""

import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl

data = sl.simulate(dry_trials=4, wet_trials=1, days=4, frames_per_trial=36)
trial = data.load(data.trials[0])
friction = float(trial.friction_coefficient[0])

# %%
# The same frames, three times: nothing told, a range told, the very number told.
told = {
    "nothing told": None,
    f"told {friction - 0.15:.2f} to {friction + 0.15:.2f}": sl.Friction.between(friction - 0.15, friction + 0.15),
    f"told {friction:.2f}": sl.Friction(friction),
}
tables = {
    name: sl.predict("chromatouch-pair", trial.frames, reference=trial.reference, friction=known).frame()
    for name, known in told.items()
}

# %%
figure, axes = plt.subplots(ncols=3, figsize=(11, 3.4), sharey=True, layout="constrained")
for ax, (name, table) in zip(axes, tables.items(), strict=True):
    margin, low, high = (100 * table[column].to_numpy() for column in ("prediction", "low_90", "high_90"))
    ax.fill_between(trial.time_s, low, high, color="#0072B2", alpha=0.2, label="90 % interval")
    ax.plot(trial.time_s, margin, color="#0072B2", label="read")
    ax.plot(trial.time_s, 100 * trial.safety_margin, "k--", label="true")
    touches = np.isfinite(trial.safety_margin)
    width = float(np.mean((high - low)[touches]))
    ax.set(title=f"{name}: {width:.0f} points wide", xlabel="Time (s)", ylim=(-2, 102))
axes[0].set_ylabel("Safety margin (%)")
axes[0].legend(loc="lower left")
plt.show()

# %%
# One trial is an example and no measure. :doc:`/limit` computes how much one frame can tell at best, and
# :doc:`/networks` has the figures of 240 trials with their intervals.
