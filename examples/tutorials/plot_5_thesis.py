r"""
Reproduce the thesis
====================

Repeat the thesis: two networks trained on raw and on difference images, their accuracy on later days, the maps of the
thesis and the recommended one, and Table 2. This page uses a few frames, which only show the steps; :doc:`/study` has
the results. The whole study is one command, about twenty minutes on two cores:
``sliplens study DATA --network thesis-difference thesis-raw -o STUDY --on processes=2``.
"""

import csv
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl
from sliplens.report.verdict import DELETION

# %%
# Data
# ----
# The preset ``thesis`` is one simulated sensor. The networks were trained on days 1 to 3 of seed 0, not on the
# last two days.
data = sl.simulate(
    preset="thesis", seed=0, days=12, test_days=2, dry_trials=(2, 1, 1, *[0] * 7, 3, 3), wet_trials=4,
    frames_per_trial=40,
)  # fmt: skip

# %%
# Accuracy (Table 1)
# ------------------
networks = {"difference images": "thesis-difference", "raw images": "thesis-raw"}
figure, axes = plt.subplots(ncols=2, figsize=(10, 4), layout="constrained")
for ax, (name, network) in zip(axes, networks.items(), strict=True):
    sl.plot(sl.evaluate(network, data), ax)
    ax.set_title(name, loc="left")
plt.show()

# %%
# A few trials only show the steps. Over six days and three networks each, R2 is 0.90 (dry) and 0.76 (wet) on difference
# images, 0.90 and 0.78 on raw images; the thesis has 0.89 and 0.66, and 0.85 and 0.57 (:doc:`/study`).

# %%
# Maps (Figs. 9 to 12)
# --------------------
# Each map explains the difference of the predicted margin from that of the last frame before the pull. Orange lowers
# the margin, blue raises it.
trial = data.load(data.select(split="test", condition="dry")[0])
number = int(np.nanargmin(np.abs(trial.safety_margin - 0.3)))
stick = int(np.flatnonzero(trial.safety_margin > 0.85)[-1])
methods = ("grad-cam-thesis", "integrated-gradients-thesis", "shapley-marker")
figure, axes = plt.subplots(ncols=3, figsize=(11, 4.2), layout="compressed")
for ax, method in zip(axes, methods, strict=True):
    maps = sl.explain(
        "thesis-difference",
        trial.frames[number : number + 1],
        reference=trial.reference,
        baseline=trial.frames[stick],
        method=method,
    )
    sl.plot(maps, ax)
    ax.set_title(method, loc="left", fontsize=10)
plt.show()

# %%
# Deletion score (Table 2)
# ------------------------
# The thesis replaces pixels by grey in 224 steps, the most salient first. Its score is the mean of
# (1 - \|y_base - y\|)\ :sup:`2` (eq. 2); lower was called better. Its curves of 42 images are drawn where the folder
# ``SLIPLENS_REFERENCE`` has them, its printed means elsewhere.
folder = Path(os.environ.get("SLIPLENS_REFERENCE", "")) / "chromatouch" / "scores" / "grey"
figure, axes = plt.subplots(ncols=2, figsize=(10, 3.8), sharey=True, layout="constrained")
for ax, (title, kind) in zip(axes, {"difference": "diff", "raw": "raw"}.items(), strict=True):
    for method, name in {"Grad-CAM": "gradcam", "Integrated Gradients": "ig", "Poly-CAM": "pcampm"}.items():
        if folder.is_dir():
            [path] = folder.glob(f"del_details_{name}-{kind}-*.csv")
            with path.open() as stream:
                curves = np.array([row[1:] for row in list(csv.reader(stream))[1:]], dtype=float)
            share = 100 * np.arange(1, curves.shape[1] + 1) / curves.shape[1]
            spread = curves.mean(axis=1).std()
            ax.plot(share, curves.mean(axis=0), label=f"{method}: {curves.mean():.2f} ± {spread:.2f}")
        else:
            mean, spread = DELETION[title, method.lower().replace(" ", "-")]
            ax.errorbar(method, mean, spread, fmt="o", capsize=4, label=f"{method}: {mean:.2f} ± {spread:.2f}")
    ax.set(title=f"{title} images", xlabel="Pixels made grey (%)" if folder.is_dir() else "", ylim=(0, 1.02))
    ax.legend(title="mean D and its spread")
axes[0].set_ylabel("Deletion score D (1)")
plt.show()

# %%
# A low score does not prove a map: a random order of pixels scores as well as some of these methods (:doc:`/deletion`).
# :doc:`/study` tests the maps against redrawn scenes instead.
