"""
Predict the margin of a recording
=================================

Predict the safety margin of every frame of a video: a figure and a table with a 90 % interval a frame. One command does
it: ``sliplens predict chromatouch-pair cup.mkv --reference-frame 0 --plot cup.png``. Then compare the margins with
labels computed from measured forces. Touch is simulated here; accuracy on real touch is nearly untested.
"""

import csv
from pathlib import Path
from tempfile import mkdtemp

import av
import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl
from sliplens.plots.sheets import write_audits

# %%
# The recording
# -------------
# You need a video of the sensor that begins before the contact. This page uses a simulated grip, saved as a lossless
# video.
folder = Path(mkdtemp())
simulated = sl.simulate(dry_trials=4, wet_trials=1, days=4, frames_per_trial=120)
trial = simulated.load(simulated.trials[0])
rate = round((len(trial.time_s) - 1) / float(trial.time_s[-1] - trial.time_s[0]))
with av.open(folder / "cup.mkv", "w") as video:
    stream = video.add_stream("ffv1", rate=rate, options={"level": "3"})
    stream.height, stream.width = trial.reference.shape[:2]
    stream.pix_fmt = "bgr0"
    for image in trial.frames:
        video.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
    video.mux(stream.encode())

# %%
# Predict
# -------
# Frame 0 shows the sensor before the contact.
predictions = sl.predict("chromatouch-pair", folder / "cup.mkv", reference_frame=0)
figure, ax = plt.subplots(figsize=(9, 3.8), layout="constrained")
sl.plot(predictions, ax)
plt.show()

# %%
# At 100 % the whole contact sticks; at 0 % the object slips. The 90 % interval is wide because a single frame hardly
# shows the friction. A known coefficient of friction makes it narrow:
friction = float(trial.friction_coefficient[0])
with_friction = sl.predict("chromatouch-pair", folder / "cup.mkv", reference_frame=0, friction=friction)
for name, result in (("unknown", predictions), (f"{friction:.2f}", with_friction)):
    table = result.frame()
    width = 100 * np.nanmean(table["high_90"].to_numpy() - table["low_90"].to_numpy())
    print(f"friction {name}: the interval is {width:.0f} points wide")

# %%
# Compare with forces
# -------------------
# If forces were recorded at the same time, `import_recordings` computes the margin of every frame. Here the force
# sensor has another clock and another zero, and its z axis points down; all three are estimated.
rng = np.random.default_rng(1)
time_s = np.arange(0, len(trial.frames) / rate, 1 / 500)
normal, pull = (
    np.interp(time_s, trial.time_s - trial.time_s[0], force)
    for force in (trial.normal_force_n, trial.tangential_force_n)
)
samples = np.column_stack([pull, 0 * pull, -normal]) + [0.3, -0.2, 1.1] + rng.normal(0, 0.02, (len(time_s), 3))
with (folder / "cup.csv").open("w", newline="") as table:
    writer = csv.writer(table)
    writer.writerow(["time [s]", "Fx [N]", "Fy [N]", "Fz [N]"])
    writer.writerows(np.column_stack([time_s, samples]).round(5).tolist())
cups = sl.import_recordings(folder / "cup.mkv", forces=folder / "cup.csv", out=folder / "cups", sensor="tip")
figure, ax = plt.subplots(figsize=(9, 3.8), layout="constrained")
sl.plot(sl.predict("chromatouch-pair", cups), ax)
plt.show()

# %%
# Check the labels before you trust them: the audit page shows the forces after tare, the ratio whose maximum is the
# friction, the margin with its uncertainty, and all flags in words.
write_audits(cups, folder / "audit")
[page] = (folder / "audit").glob("*.png")
figure, ax = plt.subplots(figsize=(12, 8.6), layout="constrained")
ax.imshow(plt.imread(page))
ax.set_axis_off()
plt.show()

# %%
# How far to trust it: on simulated sensors like those of the training R2 is 0.85 (dry) and 0.80 (wet); real touch is
# nearly untested. See :doc:`/networks`.
