"""Integrated and Expected Gradients, and SmoothGrad."""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.errors import InputError
from sliplens.explainers.attribution import Attribution, check_slopes, frame_of, widest, with_reference_of
from sliplens.explainers.contract import Comparison, Method, black_frames, freeze, require_at_least_one

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

    The line is cut into pieces. While their completeness gaps add up to more than `tolerance`, the pieces with the
    largest are halved: nodes spread over the whole line miss the sum of a trained network by percents.

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
        require_at_least_one("integrated gradients", batch_size=self.batch_size)
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
            warnings=check_slopes(slopes, change=black.change.tolist(), close=black.close),
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
        from captum import attr  # noqa: PLC0415 (half a second, for some explainers alone)

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

        edges = torch.linspace(0, 1, pieces + 1, dtype=widest(image).dtype, device=image.device)
        heights = widest(torch.cat([ends[0][None], predict(edges[1:-1]), ends[1][None]]))
        starts, stops, rises = edges[:-1], edges[1:], heights.diff()
        parts, used = integrals(starts, stops), pieces * nodes
        while True:
            gaps = widest(parts.sum(dim=(1, 2))) - rises
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
            rise = widest(predict(middles)) - widest(predict(starts[split]))
            new_starts, new_stops = torch.cat([starts[split], middles]), torch.cat([middles, stops[split]])
            starts, stops = torch.cat([starts[rest], new_starts]), torch.cat([stops[rest], new_stops])
            rises = torch.cat([rises[rest], rise, rises[split] - rise])
            parts = torch.cat([parts[rest], integrals(new_starts, new_stops)])
            used += 2 * nodes * count


@dataclass(frozen=True, kw_only=True)
class ExpectedGradients(Method):
    """Expected Gradients: the mean of Integrated Gradients over a background of references.

    The relevance adds up to f(x) less the mean of f over the background. The published method draws references and
    points of the line at random; here every line is integrated until it is complete, without noise and a seed.

    References
    ----------
    Erion et al., *Improving performance of deep learning models with axiomatic attribution priors and expected
    gradients*, Nature Machine Intelligence 2021, eq. 3.
    """

    method: ClassVar[str] = "expected-gradients"
    background: Float[Tensor, "frames colours height width"] | None = None
    """Frames without slip as the network takes them, float in [0, 1]; the call's reference is then not used, but that
    beside each image stays. Without a background the call's reference stands for it, and a warning says so."""
    integrated: IntegratedGradients = field(default_factory=IntegratedGradients)
    """How each line is integrated."""

    def _explain(self, comparison: Comparison) -> Attribution:
        predictions = comparison.prediction  # its errors are reported first
        backgrounds, heights = comparison.reference[:, None], comparison.reference_prediction[:, None]
        if self.background is not None:
            with freeze(comparison.model, self.background, reference=None) as checked:
                frames = checked.images
            backgrounds = torch.stack([with_reference_of(frames, image) for image in comparison.images])
            heights = torch.stack([replace(comparison, images=background).prediction for background in backgrounds])
        comparison = comparison.with_predictions(predictions, heights.mean(dim=1))

        def mean_over(index: int) -> Tensor:
            image, prediction = comparison.images[index], comparison.prediction[index]
            pairs = zip(backgrounds[index], heights[index], strict=True)
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

    Relevance is (x - b) times the mean of df/dx over x plus normal noise, summed over the channels; the gradient alone
    was published. Only for a linear network it adds up to f(x) - f(b), so it has no completeness gap.

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
        from captum import attr  # noqa: PLC0415 (half a second, for some explainers alone)

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
            warnings=check_slopes(relevance.abs().sum(dim=(1, 2)).tolist(), change=change, close=comparison.close),
        )
