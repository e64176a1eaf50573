"""
Import a video with forces, and look at its audit
=================================================

A video of the sensor and a table of forces become a data set in which every frame has its safety margin, with an
uncertainty and the word whether it can be trusted. Before you train on such labels, look at what they rest on.
"""

import csv
from pathlib import Path
from tempfile import mkdtemp

import av
import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl
from sliplens.plots.audit import write_audits

# %%
# What you bring
# --------------
# A simulated grip stands for the recording: its frames as a video, its forces as a sensor with another clock, a zero
# of its own and its z axis upside down would write them.
folder = Path(mkdtemp())
data = sl.simulate(dry_trials=4, wet_trials=1, days=4, frames_per_trial=150)
trial = data.load(data.trials[0])

rate = round((len(trial.time_s) - 1) / float(trial.time_s[-1] - trial.time_s[0]))
with av.open(folder / "cup.mkv", "w") as video:
    stream = video.add_stream("ffv1", rate=rate, options={"level": "3"})
    stream.height, stream.width = trial.reference.shape[:2]
    stream.pix_fmt = "bgr0"
    for image in trial.frames:
        video.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
    video.mux(stream.encode())

rng = np.random.default_rng(1)
time_s = np.arange(0, len(trial.frames) / rate, 1 / 500)
at = trial.time_s - trial.time_s[0]
normal, pull = (np.interp(time_s, at, force) for force in (trial.normal_force_n, trial.tangential_force_n))
samples = np.column_stack([pull, 0 * pull, -normal]) + [0.3, -0.2, 1.1] + rng.normal(0, 0.02, (len(time_s), 3))
with (folder / "cup.csv").open("w", newline="") as table:
    writer = csv.writer(table)
    writer.writerow(["time [s]", "Fx [N]", "Fy [N]", "Fz [N]"])
    writer.writerows(np.column_stack([time_s, samples]).round(5).tolist())

# %%
# The import
# ----------
# Tare, axes, sign, lag and friction are found from the trial itself. On the command line:
# ``sliplens import cup.mkv --forces cup.csv -o cups --sensor tip``, which draws the audit too.
cups = sl.import_recordings(folder / "cup.mkv", forces=folder / "cup.csv", out=folder / "cups", sensor="tip")
recording = cups.load(cups.trials[0])
print(f"{recording.valid.mean():.0%} of {len(recording.frames)} frames have a label that can be trusted")

# %%
# The audit
# ---------
# Everything the labels rest on, on one page: forces after tare, the ratio whose top is the friction, the margin with
# its band, pictures along it, and in words what was found, assumed or doubtful.
write_audits(cups, folder / "audit")
[page] = (folder / "audit").glob("*.png")
figure, ax = plt.subplots(figsize=(12, 8.6), layout="constrained")
ax.imshow(plt.imread(page))
ax.set_axis_off()
plt.show()
