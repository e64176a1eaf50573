"""
Predict live, and control a grip
================================

Predict the margin of a running camera (``sliplens live 0 --network chromatouch-pair``), and control a grip force with
it (``sliplens hold 0 --network chromatouch-pair --gripper ADDRESS``). Camera and gripper are simulated here; neither
was tested on a real fingertip or robot.
"""

from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl

# %%
# Live
# ----
# ``sl.read_live(0, "chromatouch-pair")`` opens the first camera. This page replays a stored trial at its
# recorded speed.
folder = Path(mkdtemp()) / "replayed"
sl.simulate(folder, dry_trials=4, wet_trials=1, days=4, frames_per_trial=120)
readings = list(sl.read_live(folder, "chromatouch-pair", seconds=9.0))
predicted = [reading for reading in readings if reading.margin is not None]
latency_ms = np.median([reading.latency.total_ms for reading in predicted])
print(f"{len(readings)} readings, {len(predicted)} with a margin, {latency_ms:.0f} ms from frame to margin (median)")

# %%
# A reading without a margin has a reason:
for reason in dict.fromkeys(reading.withheld for reading in readings if reading.withheld):
    print(reason)

# %%
figure, ax = plt.subplots(figsize=(9, 3.8), layout="constrained")
time_s = [reading.time_s for reading in predicted]
low, high = (np.multiply(100, [getattr(reading, end) for reading in predicted]) for end in ("low", "high"))
ax.fill_between(time_s, low, high, color="#0072B2", alpha=0.2, label="90 % interval")
ax.plot(time_s, [100 * reading.margin for reading in predicted], ".-", color="#0072B2", label="predicted")
truth = [(reading.time_s, 100 * reading.true_margin) for reading in readings if reading.true_margin is not None]
ax.plot(*zip(*truth, strict=True), "k--", label="true")
ax.set(xlabel="Time (s)", ylabel="Safety margin (%)", ylim=(-2, 102))
ax.legend(loc="lower left")
plt.show()

# %%
# Grip
# ----
# `run_episodes` simulates a gripper that holds a cup which gets wet. ``fixed`` uses one force, ``margin`` the predicted
# margin, ``oracle`` the true one. The same 200 episodes for each; predictions have the measured errors of the network.
grips = {
    name: sl.run_episodes("cup", name, condition="patch", episodes=200, seed=5)
    for name in ("fixed", "margin", "oracle")
}
figure, (chart, course) = plt.subplots(ncols=2, figsize=(11, 4), layout="constrained")
for name, grip in grips.items():
    excess, dropped = float(np.mean(grip.episodes.force_excess)), 100 * grip.drop_rate
    chart.plot(excess, dropped, "o", markersize=9)
    chart.annotate(f"  {name}", (excess, dropped))
chart.set(xlabel="Mean force above the least (1 = twice as much)", ylabel="Dropped (% of 200 episodes)")
chart.margins(0.2)
sl.plot(grips["margin"], course)
course.set_title("first episode of the margin controller", loc="left")
plt.show()

# %%
# How far to trust it: no real gripper has been controlled. :doc:`/grip` has all conditions with intervals.
