"""Time the explainers on an untrained ShuffleNetV2 with one output.

Each call is timed as the first of its network, whose earlier passes pay for no faster engine. Two ratios say what an
explainer adds to the passes it cannot do without: Grad-CAM against one forward and backward pass, Integrated Gradients
at 50 steps against 50 of them, both one image at a time and in batches of the same size. With `--json` the last line is
one JSON object.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torchvision import models

from sliplens.explainers.cam import GradCam
from sliplens.explainers.gradients import IntegratedGradients
from sliplens.explainers.table import EXPLAINERS, get_explainer
from sliplens.extras import missing_packages
from sliplens.files import machine, versions

STEPS = 50
INSTALLED = [name for name in EXPLAINERS if name != "lrp" or not missing_packages("zennit", extra="lrp")]


def median_seconds(work: Callable[[], object], *, repeats: int, device: torch.device) -> float:
    """Median wall-clock seconds of a call, after one call that warms caches and allocators."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])


def forward_and_backward(model: nn.Module, images: Tensor) -> Tensor:
    """Gradient of the outputs with respect to the images."""
    images = images.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(model(images).sum(), images)
    return gradient


def build(*, size: int, batch: int, device: torch.device) -> tuple[nn.Module, Tensor]:
    """Make an untrained network in evaluation mode and images of `size` pixels."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = models.shufflenet_v2_x1_0(weights=None)
        model.fc = nn.Linear(model.fc.in_features, 1)
    for parameter in model.parameters():
        parameter.requires_grad_(False)  # as while explaining: only the images take a gradient
    generator = torch.Generator().manual_seed(0)
    return model.eval().to(device), torch.rand(batch, 3, size, size, generator=generator).to(device)


def marker_grid(size: int) -> Tensor:
    """Places of 9 x 9 markers: random images show none."""
    lines = (torch.arange(9) + 0.5) * size / 9
    return torch.cartesian_prod(lines, lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description="Time the explainers on an untrained ShuffleNetV2.")
    parser.add_argument("--size", type=int, default=224, help="height and width of the images in pixels")
    parser.add_argument("--batch", type=int, default=1, help="images in a call")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls after one warm-up; the median counts")
    parser.add_argument("--methods", nargs="+", choices=EXPLAINERS, default=INSTALLED)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    options = parser.parse_args(arguments)
    model, images = build(size=options.size, batch=options.batch, device=options.device)

    def timed(work: Callable[[], object], repeats: int = options.repeats) -> float:
        return median_seconds(work, repeats=repeats, device=options.device)

    seconds, markers = {}, marker_grid(options.size)
    for name in options.methods:
        explain = get_explainer(name, **({"markers_px": markers} if name.endswith("-marker") else {}))
        # thousands of passes average out on their own; one call after the warm-up is enough
        seconds[name] = timed(lambda e=explain: e(model, images), repeats=1 if name == "poly-cam" else options.repeats)
        print(f"{name:<22} {seconds[name] / options.batch:9.4f} s an image, {options.size} px, batch {options.batch}")

    one = timed(lambda: forward_and_backward(model, images))
    many = timed(lambda: [forward_and_backward(model, images) for _ in range(STEPS)])
    block = images[:1].expand(IntegratedGradients().batch_size, -1, -1, -1).contiguous()
    batched = options.batch * STEPS / len(block) * timed(lambda: forward_and_backward(model, block))
    grad_cam = timed(lambda: GradCam()(model, images))
    fifty = timed(lambda: IntegratedGradients(steps=STEPS, max_steps=STEPS)(model, images))
    print(f"{'Grad-CAM':<22} {grad_cam / one:9.3f} x one forward and backward pass ({one:.4f} s)")
    print(f"{'IG, 50 steps':<22} {fifty / many:9.3f} x 50 forward and backward passes ({many:.4f} s)")
    print(f"{'':<22} {fifty / batched:9.3f} x the same in batches of {len(block)} ({batched:.4f} s)")
    if options.json:
        result = {
            "seconds": seconds,
            "seconds_an_image": {name: value / options.batch for name, value in seconds.items()},
            "forward_backward_seconds": one,
            "grad_cam_ratio": grad_cam / one,
            "ig_ratio": fifty / many,
            "ig_batched_ratio": fifty / batched,
            "size": options.size,
            "batch": options.batch,
            "threads": torch.get_num_threads(),
            "device": str(options.device),
            "machine": vars(machine()),
            "versions": versions(),
        }
        print(json.dumps(result))


if __name__ == "__main__":
    main()
