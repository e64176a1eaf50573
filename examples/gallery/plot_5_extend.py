"""
Add your own explainer and controller
=====================================

Pass an explainer or a controller of your own in place of a name, or register it under a name by an entry point of your
package.
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
# A function of images and a frozen network. This one multiplies the gradient half-way between the untouched sensor and
# the image by their difference.
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
midpoint = sl.explain("chromatouch-difference", frame, reference=trial.reference, method=Midpoint())
integrated = sl.explain("chromatouch-difference", frame, reference=trial.reference, method="integrated-gradients")

figure, axes = plt.subplots(ncols=2, figsize=(8, 4.4), layout="compressed")
for ax, explanation in zip(axes, (midpoint, integrated), strict=True):
    sl.plot(explanation, ax)
    ax.set_title(explanation.method, loc="left")
plt.show()


# %%
# A controller
# ------------
# One method returns the force for an observation. This force is proportional to the missing margin, and 1 N if the
# margin is unknown.
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
# Register it
# -----------
# In the ``pyproject.toml`` of your package::
#
#     [project.entry-points."sliplens.explainers"]
#     midpoint = "my_package:MIDPOINT"
#
# with ``MIDPOINT = ExplainerRow(title="Midpoint gradient", load=Midpoint)``. Then ``--method midpoint`` and
# ``method="midpoint"`` work. CONTRIBUTING.md lists all tables and their entry points.
