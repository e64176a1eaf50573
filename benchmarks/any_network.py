"""Maps and scores of eight architectures with random weights at 64 px; Integrated Gradients beside Captum's.

Each TorchVision architecture is a regressor with one output, wrapped by `sliplens.wrap`. `explained` lists the methods
that made maps, `refused` the others and why; `parity_with_captum` is the largest difference of Integrated Gradients
from Captum's with the same 32 steps, as a share of the largest value; `seconds` is the time of all.
"""

import argparse
import json
import os
import time
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # must be set before torch is imported

import numpy as np
import torch
import torchvision
from captum.attr import IntegratedGradients

import sliplens as sl
from sliplens.errors import SliplensError
from sliplens.explainers.gradients import IntegratedGradients as OurIntegratedGradients
from sliplens.explainers.table import get_explainer

ARCHITECTURES = (
    "resnet18", "efficientnet_b0", "convnext_tiny", "vit_b_16", "swin_t", "mobilenet_v3_small", "densenet121",
    "regnet_y_400mf",
)  # fmt: skip
SIZE_PX, STEPS = 64, 32
METHODS: dict[str, dict[str, Any]] = {
    "grad-cam": {},
    "integrated-gradients": {"steps": STEPS, "max_steps": STEPS},
    "smooth-grad": {"samples": 4},
    "occlusion": {"tile_px": 16},
    "shapley": {"tile_px": 16},
}


def build(name: str) -> torch.nn.Module:
    """Build an architecture with one output and random weights."""
    torch.manual_seed(0)
    size = {"image_size": SIZE_PX} if name.startswith("vit") else {}
    module = torchvision.models.get_model(name, weights=None, num_classes=1, **size).eval()
    for layer in module.modules():
        if isinstance(layer, torch.nn.Linear) and layer.out_features == 1:
            layer.reset_parameters()  # that of ViT is zero
    return module


def compare_with_captum(module: torch.nn.Module, images: torch.Tensor) -> float:
    """Compute the largest difference of Integrated Gradients by both, as a share of the largest value."""
    captum = IntegratedGradients(lambda inputs: module(inputs)[:, 0])
    theirs = captum.attribute(images, baselines=0.0, n_steps=STEPS, internal_batch_size=8)
    ours = OurIntegratedGradients(steps=STEPS, max_steps=STEPS)(module, images)
    theirs = theirs.detach().sum(dim=1)
    return float((ours.relevance - theirs).abs().max() / theirs.abs().max())


def measure(name: str, frames: np.ndarray) -> dict[str, Any]:
    """Explain and score two frames by one architecture."""
    started, module = time.perf_counter(), build(name)
    network, made, refused = sl.wrap(module, size=SIZE_PX), {}, {}
    for method, options in METHODS.items():
        try:
            explanation = sl.explain(network, frames, method=get_explainer(method, **options))
            made[method] = explanation
        except SliplensError as error:
            refused[method] = str(error)
    explanation = made["integrated-gradients"]
    scores = sl.score(network, explanation, unit="tile", random_orders=2, steps=0)
    images = torch.from_numpy(frames).permute(0, 3, 1, 2) / 255
    return {
        "explained": list(made),
        "refused": refused,
        "scored": bool(np.isfinite(scores.score("integrated-gradients").srg.estimate)),
        "parity_with_captum": compare_with_captum(module, images[:1]),
        "seconds": round(time.perf_counter() - started, 1),
    }


def main() -> None:
    """Print the results of all architectures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--architectures", nargs="+", default=ARCHITECTURES)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    frames = np.random.default_rng(0).integers(256, size=(2, 8, 8, 3), dtype=np.uint8)
    frames = frames.repeat(8, axis=1).repeat(8, axis=2)
    results = {name: measure(name, frames) for name in options.architectures}
    print(json.dumps(results, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
