"""
Read the safety margin of a frame
=================================

Frames of a camera inside the fingertip go in, and one of the sensor untouched. Out come the safety margin and the
interval that holds it with 90 % confidence.
"""

import matplotlib.pyplot as plt

import sliplens as sl

# %%
# A simulated fingertip presses an object and is pulled until it slips. Your own frames are arrays of the same kind:
# 8-bit RGB, (frames, height, width, 3), and one image of the untouched sensor.
data = sl.simulate(dry_trials=4, wet_trials=1, days=4, frames_per_trial=36)
trial = data.load(data.trials[-1])
trial.frames.shape, trial.reference.shape

# %%
# One call reads them, by the name of a network that comes with the package.
readings = sl.predict("chromatouch-pair", trial.frames, reference=trial.reference)
table = readings.frame()
table.column_names

# %%
# The true margin is known here, for the touch is simulated. At 100 % the contact sticks fully, at 0 % it begins to
# slip. The interval is wide because friction hardly shows in one frame.
margin, low, high = (100 * table[name].to_numpy() for name in ("prediction", "low_90", "high_90"))
frame = 3 * len(margin) // 5

figure, (picture, chart) = plt.subplots(ncols=2, figsize=(9, 3.6), width_ratios=(1, 1.8), layout="compressed")
picture.imshow(trial.frames[frame])
picture.set(title=f"{trial.time_s[frame]:.1f} s: read {margin[frame]:.0f} %", xticks=[], yticks=[])
chart.fill_between(trial.time_s, low, high, color="#0072B2", alpha=0.2, label="90 % interval")
chart.plot(trial.time_s, margin, color="#0072B2", label="read")
chart.plot(trial.time_s, 100 * trial.safety_margin, color="black", linestyle="--", label="true")
chart.axvline(trial.time_s[frame], color="grey", linewidth=1)
chart.set(xlabel="Time (s)", ylabel="Safety margin (%)", ylim=(-2, 102))
chart.legend(loc="lower left")
plt.show()
