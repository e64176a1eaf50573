r"""
Table 2 of the thesis from its recorded curves
==============================================

The thesis scored three methods by deletion: pixels become grey in 224 steps, the most salient first, and the score is
(1 - \|y_base - y\|)\ :sup:`2` of eq. 2, averaged over the steps. Its curves of 42 images were recorded. Where they
are at hand (the folder in ``SLIPLENS_REFERENCE``), this page computes the table's means from them; elsewhere it shows
the numbers that the thesis prints.
"""

import csv
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sliplens.report.comparisons import DELETION

folder = Path(os.environ.get("SLIPLENS_REFERENCE", "")) / "chromatouch" / "scores" / "grey"
methods = {"Grad-CAM": "gradcam", "Integrated Gradients": "ig", "Poly-CAM": "pcampm"}
inputs = {"difference images": "diff", "raw images": "raw"}

# %%
figure, axes = plt.subplots(ncols=2, figsize=(10, 3.8), sharey=True, layout="constrained")
for ax, (title, kind) in zip(axes, inputs.items(), strict=True):
    for method, name in methods.items():
        if folder.is_dir():
            [path] = folder.glob(f"del_details_{name}-{kind}-*.csv")
            with path.open() as stream:
                curves = np.array([row[1:] for row in list(csv.reader(stream))[1:]], dtype=float)
            mean, spread = curves.mean(), curves.mean(axis=1).std()
            share = 100 * np.arange(1, curves.shape[1] + 1) / curves.shape[1]
            ax.plot(share, curves.mean(axis=0), label=f"{method}: {mean:.2f} ± {spread:.2f}")
        else:
            mean, spread = DELETION[title.removesuffix(" images"), method.lower().replace(" ", "-")]
            ax.errorbar(method, mean, spread, fmt="o", capsize=4, label=f"{method}: {mean:.2f} ± {spread:.2f}")
    ax.set(title=title, xlabel="Pixels made grey (%)" if folder.is_dir() else "", ylim=(0, 1.02))
    ax.legend(title="mean D and its spread")
axes[0].set_ylabel("Deletion score D (1)")
plt.show()
if not folder.is_dir():
    print("The recorded curves are not at hand: these are the means and spreads that the thesis prints.")

# %%
# Lower is called better. A random order is no method of the thesis, and on networks trained as the thesis trained its
# own it does as well as a method or better: :doc:`/deletion` tells what the score is worth.
