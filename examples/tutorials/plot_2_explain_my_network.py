"""
Explain and test my own regressor
=================================

Explain any PyTorch module with one output an image: ``maps = sl.explain(module, frames)`` has signed maps in the unit
of the output, and ``sl.score(module, maps)`` tests whether they can be trusted. The example is not about touch: the
network estimates the slant of a handwritten digit.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch
from captum.attr import DeepLift
from sklearn.datasets import load_digits
from torch import nn

import sliplens as sl
from sliplens.explainers.table import get_explainer

# %%
# A network and its data
# ----------------------
# The data are the 1,797 handwritten digits of 8 x 8 pixels that come with scikit-learn (UCI, test set of *Optical
# Recognition of Handwritten Digits*). The number to predict is the slant of the digit, computed from the second
# moments of its ink: the shift in pixels of a row for each row further down. One network is trained for some seconds.
digits = load_digits().images.astype(np.float32) / 16
y, x = np.mgrid[:8, :8]
ink = digits / digits.sum(axis=(1, 2), keepdims=True)
mean_x, mean_y = ((ink * place).sum(axis=(1, 2)) for place in (x, y))
dx, dy = x - mean_x[:, None, None], y - mean_y[:, None, None]
slant = ((ink * dx * dy).sum(axis=(1, 2)) / (ink * dy**2).sum(axis=(1, 2))).astype(np.float32)

torch.manual_seed(0)
module = nn.Sequential(
    nn.Conv2d(3, 16, 3, padding=1), nn.ReLU(), nn.Conv2d(16, 16, 3, padding=1), nn.ReLU(), nn.Flatten(),
    nn.Linear(16 * 16 * 16, 32), nn.ReLU(), nn.Linear(32, 1),
)  # fmt: skip
frames = np.round(255 * digits).astype(np.uint8).repeat(2, axis=1).repeat(2, axis=2)[..., None].repeat(3, axis=3)
images = torch.from_numpy(frames).permute(0, 3, 1, 2) / 255
labels = torch.from_numpy(slant)
train, test = np.arange(1400), np.arange(1400, len(frames))
optimizer = torch.optim.Adam(module.parameters(), lr=1e-3)
for _ in range(15):
    for batch in torch.randperm(len(train)).split(64):
        loss = nn.functional.mse_loss(module(images[batch])[:, 0], labels[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
module.eval()

# %%
# Predict and explain
# -------------------
# `wrap` names the size of the input and the unit of the output. ``preprocess=`` would be a normalisation, and
# ``output=`` the number of one of several outputs.
network = sl.wrap(module, size=16, unit="px a row")
predicted = sl.predict(network, frames[test]).frame()["prediction"].to_numpy()
r2 = 1 - np.mean((predicted - slant[test]) ** 2) / slant[test].var()
print(f"R2 on {len(test)} digits that were not trained on: {r2:.2f}")

extremes = test[np.argsort(slant[test])[[0, 1, 2, 3, 4, 5, -6, -5, -4, -3, -2, -1]]]
methods = (get_explainer("integrated-gradients"), get_explainer("occlusion", tile_px=4))
maps = sl.explain(network, frames[extremes], method=methods)
figure, axes = plt.subplots(ncols=2, figsize=(10, 4), layout="constrained")
for ax, index in zip(axes, (0, len(extremes) - 1), strict=True):
    sl.plot(maps, ax, index=index)
plt.show()

# %%
# Test the maps
# -------------
# The score removes the pixels that a map ranks highest, then those it ranks lowest, and compares the changes of the
# prediction. Random orders and controls, which use nothing the network learned, are scored as well. A map of another
# library goes in as an array: here DeepLift of Captum.
baseline = torch.zeros_like(images[extremes])
deep_lift = DeepLift(module).attribute(images[extremes].requires_grad_(), baselines=baseline).sum(dim=1)
scores = {
    "ours": sl.score(network, maps),
    "DeepLift": sl.score(network, frames[extremes], deep_lift.detach().numpy()),
}
for name, score in scores.items():
    print(name, score)
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
sl.plot(scores["ours"], ax)
plt.show()

# %%
# How far to trust it: a map is better than another only where the interval of their difference excludes zero, and it
# must be better than every control. Twelve digits and one network only show the steps. Black is the
# background of the training images, so it is a suitable baseline here; for other images choose ``baseline="mean"``,
# ``"blurred"`` or an image.
