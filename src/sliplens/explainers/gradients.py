"""Integrated and Expected Gradients, and SmoothGrad."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from sliplens.explainers.attribution import Attribution, black_frames, frame_of, widest, with_reference_of
from sliplens.explainers.contract import BATCH, Comparison, Method, require_images

_NODES = 4  # of a piece; the slope along the path has kinks, on which more nodes to a piece are wasted
_ROUNDING = 1e-6  # of |f|: a gap that float32 predictions cannot resolve is no gap
_TOLERANCE = 0.01  # completeness gap allowed, as a share of |f(x) - f(b)|


@dataclass(frozen=True, kw_only=True)
class IntegratedGradients(Method):
    """Integrated Gradients along the straight line from the reference, with as many steps as completeness needs.

    Relevance is (x - b) times the integral over t in [0, 1] of df/dx at b + t (x - b), summed over the channels; it
    adds up to f(x) - f(b) when the integral is exact.

    The line is cut into pieces. While their completeness gaps add up to more than 1 %, the pieces with the largest are
    halved: nodes spread over the whole line miss the sum of a trained network by percents.

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
    black: bool = False
    """Start from the black image instead, as published: relevance adds up to f(x) - f(black), and the reference only
    decides what `Explanation.saliency` shows."""

    def _explain(self, comparison: Comparison) -> Attribution:
        line, slopes = comparison, []
        if self.black:
            line = replace(comparison, references=black_frames(comparison.references))

        def integral(index: int) -> Tensor:
            relevance, slope = self.integrate(line, index)
            slopes.append(slope)
            return relevance

        return comparison.attribution(
            comparison.map_each(integral),
            complete=not self.black,
            target=f"f(x) - f({'black' if self.black else 'reference'})",
            warnings=line.saturated(slopes),
        )

    def integrate(self, comparison: Comparison, index: int) -> tuple[Float[Tensor, "height width"], float]:
        """Integrate the gradients from the reference of an image to the image.

        The second value is the sum of |relevance| if the slope of the last piece, next to the image, held along the
        whole line.
        """
        from captum import attr  # noqa: PLC0415 (half a second, for some explainers alone)

        image, reference = comparison.images[index], comparison.reference[index]
        ends = comparison.reference_prediction[index], comparison.prediction[index]
        change = float(ends[1] - ends[0])
        allowed = max(_TOLERANCE * abs(change), _ROUNDING * max(abs(float(end)) for end in ends))
        fixed = self.steps == self.max_steps
        pieces, nodes = (1, self.steps) if fixed else (max(1, self.steps // _NODES), min(self.steps, _NODES))
        together, captum = max(1, BATCH // nodes), attr.IntegratedGradients(comparison.predict)

        def at(times: Tensor) -> Tensor:
            """Points of the line, 0 the reference and 1 the image."""
            return reference + times.to(image.dtype)[:, None, None, None] * (image - reference)

        @torch.no_grad()
        def predict(times: Tensor) -> Tensor:
            parts = [comparison.predict(at(part)) for part in times.split(BATCH) if len(part)]
            return torch.cat(parts) if parts else image.new_zeros(0)

        def integrals(starts: Tensor, stops: Tensor) -> Tensor:
            """Relevance (pieces, height, width) of each piece of the line."""
            pieces = []
            for start, stop in zip(starts.split(together), stops.split(together), strict=True):
                contributions = captum.attribute(
                    at(stop),
                    baselines=at(start),
                    n_steps=nodes,
                    internal_batch_size=max(len(start), min(BATCH, len(start) * nodes)),
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
                return parts.sum(dim=0), float(slope)
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
class ExpectedGradients(IntegratedGradients):
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

    def _explain(self, comparison: Comparison) -> Attribution:
        if self.background is None:
            alone = "no background was given, so the reference alone stands for it, as in integrated gradients"
            attribution = super()._explain(comparison)
            return replace(attribution, warnings=(*attribution.warnings, alone))
        require_images(self.background)
        frames = self.background.to(comparison.images).split(1)
        lines = [replace(comparison, references=with_reference_of(frame, comparison.images)) for frame in frames]
        comparison.reference_prediction = torch.stack([line.reference_prediction for line in lines]).mean(dim=0)
        return comparison.attribution(
            comparison.map_each(
                lambda index: torch.stack([self.integrate(line, index)[0] for line in lines]).mean(dim=0)
            ),
            complete=True,
            target="f(x) - mean of f over the background",
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

    def _explain(self, comparison: Comparison) -> Attribution:
        from captum import attr  # noqa: PLC0415 (half a second, for some explainers alone)

        def smoothed(index: int) -> Tensor:
            image = comparison.images[index, None]
            tunnel = attr.NoiseTunnel(attr.Saliency(lambda noisy: comparison.predict(with_reference_of(noisy, image))))
            # Captum draws from the global state, which is restored
            with torch.random.fork_rng(devices=[image.device] if image.is_cuda else []):
                torch.manual_seed(0)
                gradient: Any = tunnel.attribute(
                    frame_of(image),
                    nt_type="smoothgrad",
                    nt_samples=self.samples,
                    nt_samples_batch_size=min(BATCH, self.samples),
                    stdevs=float(self.noise),
                    abs=False,
                )
            return (gradient.detach() * frame_of(image - comparison.reference[index])).sum(dim=1)[0]

        _ = comparison.change  # errors of its predictions are reported first
        relevance = comparison.map_each(smoothed)
        return comparison.attribution(
            relevance,
            complete=False,
            target="the linear model of f at x",
            warnings=comparison.saturated(relevance.abs().sum(dim=(1, 2)).tolist()),
        )
