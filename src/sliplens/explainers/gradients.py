"""Integrated and Expected Gradients, SmoothGrad, and layer-wise relevance propagation by zennit (an extra)."""

import operator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import torch
from captum import attr
from jaxtyping import Float
from torch import Tensor, fx, nn

from sliplens.errors import InputError
from sliplens.explainers.attribution import Attribution, check_slopes, frame_of, with_reference_of
from sliplens.explainers.contract import Comparison, Method, black_frames, freeze, require_at_least_one
from sliplens.explainers.folding import fold_batch_norm
from sliplens.extras import require_packages
from sliplens.models.backbones import HistogramRegressor
from sliplens.progress import report_each

_NODES = 4  # of a piece; the slope along the path has kinks, on which more nodes to a piece are wasted
_ROUNDING = 1e-6  # of |f|: a gap that float32 predictions cannot resolve is no gap


class LineIntegral(NamedTuple):
    """Integral of the gradients from a reference to an image."""

    relevance: Float[Tensor, "height width"]
    slope: float
    """Sum of |relevance| if the slope of the last piece, next to the image, held along the whole line."""


@dataclass(frozen=True, kw_only=True)
class IntegratedGradients(Method):
    """Integrated Gradients along the straight line from the reference, with as many steps as completeness needs.

    Relevance is (x - b) times the integral over t in [0, 1] of df/dx at b + t (x - b), summed over the channels; it
    adds up to f(x) - f(b) when the integral is exact.

    The line is cut into pieces, each with a completeness gap of its own, between its part of the integral and the
    change of f from its start to its end. While the gaps add up to more than `tolerance` the pieces with the largest
    are halved: nodes spread over the whole line miss the sum of a trained network by percents.

    References
    ----------
    Sundararajan, Taly and Yan, *Axiomatic attribution for deep networks*, ICML 2017, eq. 1; each piece by Captum.

    Examples
    --------
    A network that reads the mean brightness, and an image with one bright pixel:

    >>> import torch
    >>> from sliplens.explainers.gradients import IntegratedGradients
    >>> network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool3d(1), torch.nn.Flatten())
    >>> images = torch.zeros(1, 3, 2, 2)
    >>> images[0, :, 0, 1] = 1.0
    >>> IntegratedGradients()(network, images).relevance
    tensor([[[0.0000, 0.2500],
             [0.0000, 0.0000]]])
    """

    method: ClassVar[str] = "integrated-gradients"
    steps: int = 32
    """Steps (Gauss-Legendre nodes) to start with, four to a piece."""
    max_steps: int = 1024
    """Most steps; an image that needs more keeps its gap and a warning. Equal to `steps` for one rule over the whole
    line, as it was published."""
    tolerance: float = 0.01
    """Completeness gap allowed, as a share of |f(x) - f(b)|."""
    black: bool = False
    """Start from the black image instead, as published: relevance adds up to f(x) - f(black), and the reference only
    decides what `saliency` shows."""
    batch_size: int = 32

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= self.max_steps:
            raise InputError(
                f"integrated gradients has steps = {self.steps} and max_steps = {self.max_steps}; "
                "give 1 <= steps <= max_steps"
            )
        if self.batch_size < 1:
            raise InputError(f"integrated gradients' batch_size is {self.batch_size}; give at least 1")
        if not self.tolerance > 0:
            raise InputError(f"integrated gradients' tolerance is {self.tolerance}; give a share above 0")

    def _explain(self, comparison: Comparison) -> Attribution:
        black, slopes = comparison, []
        if self.black:
            black = replace(comparison, references=black_frames(comparison.references))
        pairs = (black.images, black.reference, black.prediction, black.reference_prediction)

        def integral(index: int) -> Tensor:
            relevance, slope = self.integrate(comparison, *(values[index] for values in pairs))
            slopes.append(slope)
            return relevance

        return comparison.attribution(
            comparison.map_each(integral),
            complete=not self.black,
            target=f"f(x) - f({'black' if self.black else 'reference'})",
            warnings=check_slopes(slopes, change=black.change.tolist()),
        )

    def integrate(
        self,
        comparison: Comparison,
        image: Float[Tensor, "colours height width"],
        reference: Float[Tensor, "colours height width"],
        prediction: Float[Tensor, ""],
        reference_prediction: Float[Tensor, ""],
    ) -> LineIntegral:
        """Integrate from one reference b to one image x, whose predictions are f(b) and f(x)."""
        ends = reference_prediction, prediction
        change = float(prediction - reference_prediction)
        allowed = max(self.tolerance * abs(change), _ROUNDING * max(abs(float(end)) for end in ends))
        fixed = self.steps == self.max_steps
        pieces, nodes = (1, self.steps) if fixed else (max(1, self.steps // _NODES), min(self.steps, _NODES))
        together, captum = max(1, self.batch_size // nodes), attr.IntegratedGradients(comparison.predict)

        def at(times: Tensor) -> Tensor:
            """Points of the line, 0 the reference and 1 the image."""
            return reference + times.to(image.dtype)[:, None, None, None] * (image - reference)

        @torch.no_grad()
        def predict(times: Tensor) -> Tensor:
            parts = [comparison.predict(at(part)) for part in times.split(self.batch_size) if len(part)]
            return torch.cat(parts) if parts else image.new_zeros(0)

        def integrals(starts: Tensor, stops: Tensor) -> Tensor:
            """Relevance (pieces, height, width) of each piece of the line."""
            pieces = []
            for start, stop in zip(starts.split(together), stops.split(together), strict=True):
                batch_size = max(len(start), min(self.batch_size, len(start) * nodes))
                contributions = captum.attribute(
                    at(stop), baselines=at(start), n_steps=nodes, internal_batch_size=batch_size
                )
                pieces.append(contributions.detach().sum(dim=1))
            return torch.cat(pieces)

        edges = torch.linspace(0, 1, pieces + 1, dtype=torch.float64, device=image.device)
        heights = torch.cat([ends[0][None], predict(edges[1:-1]), ends[1][None]]).double()
        starts, stops, rises = edges[:-1], edges[1:], heights.diff()
        parts, used = integrals(starts, stops), pieces * nodes
        while True:
            gaps = parts.sum(dim=(1, 2)).double() - rises
            rooms = (self.max_steps - used) // (2 * nodes)
            if abs(float(gaps.sum())) <= allowed or rooms == 0:
                last = int(stops.argmax())
                slope = parts[last].abs().sum() / (stops[last] - starts[last])
                return LineIntegral(relevance=parts.sum(dim=0), slope=float(slope))
            shares, order = gaps.abs().sort(descending=True)
            # the fewest pieces that hold half of all gaps
            count = min(int((shares.cumsum(0) < shares.sum() / 2).sum()) + 1, rooms)
            split, rest = order[:count], order[count:]
            middles = (starts[split] + stops[split]) / 2
            rise = predict(middles).double() - predict(starts[split]).double()
            new_starts, new_stops = torch.cat([starts[split], middles]), torch.cat([middles, stops[split]])
            starts, stops = torch.cat([starts[rest], new_starts]), torch.cat([stops[rest], new_stops])
            rises = torch.cat([rises[rest], rise, rises[split] - rise])
            parts = torch.cat([parts[rest], integrals(new_starts, new_stops)])
            used += 2 * nodes * count


@dataclass(frozen=True, kw_only=True)
class ExpectedGradients(Method):
    """Expected Gradients: the mean of Integrated Gradients over a background of references.

    The relevance adds up to f(x) less the mean of f over the background. The published method draws references and
    points of the line at random; here the background is gone through and each line integrated until it is complete,
    which gives the same in the limit, without noise and without a seed.

    References
    ----------
    Erion et al., *Improving performance of deep learning models with axiomatic attribution priors and expected
    gradients*, Nature Machine Intelligence 2021, eq. 3.
    """

    method: ClassVar[str] = "expected-gradients"
    background: Float[Tensor, "frames colours height width"] | None = None
    """Frames without slip as the network takes them, float in [0, 1], shape (frames, 3, height, width); the call's
    reference is then not used, but that beside each image stays where the network sees one. Without a background the
    call's reference is the whole of it, and a warning says so."""
    integrated: IntegratedGradients = field(default_factory=IntegratedGradients)
    """How each line is integrated."""

    def _explain(self, comparison: Comparison) -> Attribution:
        def background_of(index: int) -> Comparison:
            """Return the background of an image as images of the network's type, after checking them."""
            image = comparison.images[index]
            if self.background is None:
                alone = replace(comparison, images=comparison.reference[index, None])
                return alone.with_predictions(*[comparison.reference_prediction[index, None]] * 2)
            with freeze(comparison.model, self.background, reference=None) as background:
                return replace(background, images=with_reference_of(background.images, image))

        predictions = comparison.prediction  # its errors are reported first
        heights = torch.stack([background_of(index).prediction for index in range(len(predictions))])
        comparison = comparison.with_predictions(predictions, heights.mean(dim=1))

        def mean_over(index: int) -> Tensor:
            image, prediction = comparison.images[index], comparison.prediction[index]
            pairs = zip(background_of(index).images, heights[index], strict=True)
            lines = [self.integrated.integrate(comparison, image, frame, prediction, height) for frame, height in pairs]
            return torch.stack([relevance for relevance, _ in lines]).mean(dim=0)

        alone = "no background was given, so the reference alone stands for it, as in integrated gradients"
        return comparison.attribution(
            comparison.map_each(mean_over),
            complete=True,
            target="f(x) - f(reference)" if self.background is None else "f(x) - mean of f over the background",
            warnings=(alone,) if self.background is None else (),
        )


@dataclass(frozen=True, kw_only=True)
class SmoothGrad(Method):
    """SmoothGrad times what the image adds to the reference, signed, in margin units.

    Relevance is (x - b) times the mean of df/dx over x plus normal noise, summed over the channels. The gradient alone,
    which was published, has another unit than the other maps and lights up where the image equals the reference. Only
    for a linear network it adds up to f(x) - f(b), so it has no completeness gap.

    References
    ----------
    Smilkov et al., *SmoothGrad: removing noise by adding noise*, 2017, section 3; computed by Captum.
    """

    method: ClassVar[str] = "smooth-grad"
    samples: int = 32
    noise: float = 0.1
    """Standard deviation of the noise, in units of the input's range [0, 1]; the same draws for each image."""
    batch_size: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        require_at_least_one("SmoothGrad", samples=self.samples, batch_size=self.batch_size)
        if not self.noise >= 0:
            raise InputError(f"SmoothGrad's noise is {self.noise}; give a standard deviation of at least 0")

    def _explain(self, comparison: Comparison) -> Attribution:
        change = comparison.change.tolist()

        def smoothed(index: int) -> Tensor:
            image, frame = comparison.images[index], frame_of(comparison.images[index, None])
            tunnel = attr.NoiseTunnel(attr.Saliency(lambda noisy: comparison.predict(with_reference_of(noisy, image))))
            # Captum draws from the global state, which is restored
            with torch.random.fork_rng(devices=[image.device] if image.is_cuda else []):
                torch.manual_seed(self.seed)
                gradient: Any = tunnel.attribute(
                    frame,
                    nt_type="smoothgrad",
                    nt_samples=self.samples,
                    nt_samples_batch_size=min(self.batch_size, self.samples),
                    stdevs=float(self.noise),
                    abs=False,
                )
            return (gradient.detach() * (frame - frame_of(comparison.reference[index]))).sum(dim=1)[0]

        relevance = comparison.map_each(smoothed)
        return comparison.attribution(
            relevance,
            complete=False,
            target="the linear model of f at x",
            warnings=check_slopes(relevance.abs().sum(dim=(1, 2)).tolist(), change=change),
        )


_TOLERANCE = 0.1  # share of f(x) by which the relevance may miss it without a warning


@dataclass(frozen=True, kw_only=True)
class Lrp(Method):
    """Layer-wise relevance propagation: alpha-1-beta-0 in convolutions, epsilon in linear layers, flat in the first.

    The prediction is handed back from layer to layer, each giving its inputs their share of its output. A histogram
    has no share of its own: its mean is handed to the logits as gradient times logit. Biases keep their share, and
    the prediction itself is handed back, not its difference from the reference, so there is no completeness gap, and
    the reference only decides what `saliency` shows. Where the network sees the reference beside the frame, the map is
    what the frame gets back.

    Works on a copy whose batch normalisation is folded into the convolutions, and whose means over space and sums of
    branches, functions in TorchVision's networks, are made modules: zennit knows rules for modules only.

    References
    ----------
    Bach et al., *On pixel-wise explanations for non-linear classifier decisions by layer-wise relevance propagation*,
    PLOS ONE 2015, eqs. 58 and 60; the composite as in Anders et al., *Software for dataset-wide XAI*, 2021 (zennit).
    """

    method: ClassVar[str] = "lrp"
    batch_size: int = 32

    def _explain(self, comparison: Comparison) -> Attribution:
        require_packages("zennit", extra="lrp", purpose="LRP")
        prediction = comparison.prediction
        copy = fold_batch_norm(comparison.model)
        for module in copy.modules():
            if isinstance(module, fx.GraphModule):
                _name_functions(module)
        parts = comparison.images.split(self.batch_size)
        relevance = torch.cat(
            [_propagate(copy, part) for part in report_each(parts, sizes=[len(part) for part in parts])]
        )
        shares = (relevance.sum(dim=(1, 2, 3)) / prediction).tolist()
        return comparison.attribution(
            frame_of(relevance).sum(dim=1),
            complete=False,
            target="f(x)",
            warnings=[
                f"image {index}: LRP hands back {share:.3g} times f(x); biases keep some of it, products make more"
                for index, share in enumerate(shares)
                if not abs(share - 1) <= _TOLERANCE
            ],
        )


class _Sum(nn.Module):
    """A sum of two branches, by the module that zennit has a rule for."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        return self.inner(torch.stack(torch.broadcast_tensors(first, second), dim=-1))


def _name_functions(module: fx.GraphModule) -> None:
    """Replace sums of two branches and means over space by modules."""
    from zennit.layer import Sum  # noqa: PLC0415  # pyright: ignore[reportMissingImports] (an extra)

    for place, node in enumerate(list(module.graph.nodes)):
        branches = [argument for argument in node.args if isinstance(argument, fx.Node)]
        if node.op == "call_function" and node.target in {operator.add, operator.iadd, torch.add}:
            replacement = _Sum(Sum()) if len(branches) == 2 else None
        elif node.op == "call_method" and node.target == "mean" and _over_space(node):
            pool = nn.AdaptiveAvgPool2d(1)
            replacement = pool if node.kwargs.get("keepdim", False) else nn.Sequential(pool, nn.Flatten())
        else:
            replacement = None
        if replacement is not None:
            module.add_submodule(name := f"lrp_{place}", replacement)
            with module.graph.inserting_after(node):
                call = module.graph.call_module(name, tuple(branches))
            node.replace_all_uses_with(call)
            module.graph.erase_node(node)
    module.recompile()


def _over_space(node: fx.Node) -> bool:
    dims = node.kwargs.get("dim", node.args[1] if len(node.args) > 1 else None)
    return isinstance(dims, list | tuple) and tuple(dims) in {(2, 3), (-2, -1)}


def _propagate(model: nn.Module, images: Tensor) -> Tensor:
    from zennit.composites import EpsilonPlusFlat  # noqa: PLC0415  # pyright: ignore[reportMissingImports] (an extra)

    composite: Any = EpsilonPlusFlat()
    images = images.clone().requires_grad_()
    with composite.context(model) as changed:
        if isinstance(changed, HistogramRegressor):
            logits, _ = changed.split(changed.backbone(images))
            free = logits.detach().requires_grad_()
            mean = torch.softmax(free / changed.temperature, dim=-1) @ changed.centres
            (slopes,) = torch.autograd.grad(mean.sum(), free)
            output, start = logits, slopes * free.detach()
        else:
            output = changed(images)
            start = output.detach()
        (relevance,) = torch.autograd.grad(output, images, grad_outputs=start)
    return relevance
