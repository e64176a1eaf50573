"""
Add your own explainer and controller
=====================================

Explainers, fills, readers of files, encodings and controllers are rows of tables. One of your own goes in wherever a
name goes, and a package of yours adds it for good through an entry point.
"""

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import torch

import sliplens as sl
from sliplens.explainers.attribution import Attribution
from sliplens.explainers.contract import Comparison, Method
from sliplens.grip.controllers import Observation

data = sl.simulate(dry_trials=4, wet_trials=1, days=4, frames_per_trial=40)
trial = data.load(data.trials[0])


# %%
# An explainer
# ------------
# One function of checked images and a frozen network. This one takes the gradient half-way between the untouched
# sensor and the image, times what the image adds.
@dataclass(frozen=True)
class Midpoint(Method):
    """Gradient half-way between reference and image, times their difference."""

    method = "midpoint"
    share: float = 0.5

    def _explain(self, comparison: Comparison) -> Attribution:
        added = comparison.images - comparison.reference
        point = (comparison.reference + self.share * added).requires_grad_()
        [gradient] = torch.autograd.grad(comparison.predict(point).sum(), point)
        return comparison.attribution((gradient * added).sum(dim=1).detach(), complete=False)


frame = trial.frames[24:25]
own = sl.explain("chromatouch-difference", frame, reference=trial.reference, method=Midpoint())
known = sl.explain("chromatouch-difference", frame, reference=trial.reference, method="integrated-gradients")

figure, axes = plt.subplots(ncols=2, figsize=(8, 4.4), layout="compressed")
for ax, explanation in zip(axes, (own, known), strict=True):
    sl.plot(explanation, ax)
    ax.set_title(explanation.method, loc="left")
plt.show()


# %%
# A controller
# ------------
# One method: what to press with, given what is known. This one presses with a force in proportion to what the
# readings lack, and with 1 N where none is shown.
class Proportional:
    """Force in proportion to the missing margin."""

    def command(self, observation: Observation) -> np.ndarray:
        """Grip force to press with, in newtons."""
        margin = np.nanmin(np.where(np.isfinite(observation.margin), observation.margin, 1.0), axis=1)
        return 1.0 + 3.0 * (1.0 - margin)


grip = sl.run_episodes("cup", Proportional(), condition="jolt", episodes=1, seed=3)
figure, ax = plt.subplots(figsize=(7, 3.8), layout="constrained")
sl.plot(grip, ax)
plt.show()

# %%
# For good
# --------
# In the ``pyproject.toml`` of a package of yours::
#
#     [project.entry-points."sliplens.explainers"]
#     midpoint = "my_package:MIDPOINT"
#
# with ``MIDPOINT = ExplainerRow(title="Midpoint gradient", load=Midpoint)``, and a colour and line where you like.
#
# Then ``--method midpoint`` and ``method="midpoint"`` know it. CONTRIBUTING.md lists all tables with their entry
# points.
