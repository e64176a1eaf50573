r"""
Table 2 of the thesis from its recorded curves
==============================================

The thesis scored three methods by deletion: pixels become grey in 224 steps, the most salient first, and the score is
(1 - \|y_base - y\|)\ :sup:`2` of eq. 2, averaged over the steps. Its curves of 42 images were recorded. Where they
are at hand (the folder in ``SLIPLENS_REFERENCE``), this page computes the table's means from them; elsewhere it says
so.
"""

import csv
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

folder = Path(os.environ.get("SLIPLENS_REFERENCE", "")) / "chromatouch" / "scores" / "grey"
methods = {"Grad-CAM": "gradcam", "Integrated Gradients": "ig", "Poly-CAM": "pcampm"}
inputs = {"difference images": "diff", "raw images": "raw"}

# %%
figure, axes = plt.subplots(ncols=2, figsize=(10, 3.8), sharey=True, layout="constrained")
if not folder.is_dir():
    for ax in axes:
        ax.text(0.5, 0.5, "the recorded curves are not at hand", ha="center", transform=ax.transAxes)
else:
    for ax, (title, kind) in zip(axes, inputs.items(), strict=True):
        for method, name in methods.items():
            [path] = folder.glob(f"del_details_{name}-{kind}-*.csv")
            with path.open() as stream:
                curves = np.array([row[1:] for row in list(csv.reader(stream))[1:]], dtype=float)
            scores = curves.mean(axis=1)
            share = 100 * np.arange(1, curves.shape[1] + 1) / curves.shape[1]
            ax.plot(share, curves.mean(axis=0), label=f"{method}: {scores.mean():.2f} ± {scores.std():.2f}")
        ax.set(title=title, xlabel="Pixels made grey (%)", ylim=(0, 1.02))
        ax.legend(title="mean D and its spread")
axes[0].set_ylabel("Deletion score D (1)")
plt.show()

# %%
# Lower is called better. A random order is no method of the thesis, and on networks trained as the thesis trained its
# own it does as well as a method or better: :doc:`/deletion` tells what the score is worth.
