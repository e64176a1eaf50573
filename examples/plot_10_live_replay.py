"""
A live reading of a replayed trial
==================================

A running sensor is read frame by frame, and every reading says when it was captured, how sure it is, and why there is
no margin where there is none. Here a stored trial is replayed at its own pace in place of a camera.
"""

from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl

folder = Path(mkdtemp()) / "replayed"
data = sl.simulate(folder, dry_trials=4, wet_trials=1, days=4, frames_per_trial=120)

# %%
# ``sl.read_live(0, network)`` reads the first camera; a number, a network stream, a growing folder, a bag or a data
# set all go in as the source. Reading stops by itself when the trial ends, or after ``seconds``.
readings = list(sl.read_live(folder, "chromatouch-pair", seconds=9.0))
shown = [reading for reading in readings if reading.margin is not None]
print(f"{len(readings)} readings, {len(shown)} with a margin")
print(f"from capture to margin: {np.median([reading.latency.total_ms for reading in shown]):.0f} ms (median)")

# %%
# A margin that is not to be believed is not shown: a sentence stands in its place.
for reason in dict.fromkeys(reading.withheld for reading in readings if reading.withheld):
    print(reason)

# %%
figure, ax = plt.subplots(figsize=(9, 3.8), layout="constrained")
time_s = [reading.time_s for reading in shown]
ax.fill_between(
    time_s,
    *(np.multiply(100, [getattr(one, end) for one in shown]) for end in ("low", "high")),
    color="#0072B2",
    alpha=0.2,
    label="90 % interval",
)
ax.plot(time_s, [100 * reading.margin for reading in shown], ".-", color="#0072B2", label="read")
truth = [(one.time_s, 100 * one.true_margin) for one in readings if one.true_margin is not None]
ax.plot(*zip(*truth, strict=True), "k--", label="true")
ax.set(xlabel="Time (s)", ylabel="Safety margin (%)", ylim=(-2, 102))
ax.legend(loc="lower left")
plt.show()
