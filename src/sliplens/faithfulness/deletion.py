"""The deletion score of the thesis: remove the most salient pixels and watch the answer."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Float64, Int
from torch import Tensor

from sliplens.arrays import require_saliency
from sliplens.errors import InputError
from sliplens.faithfulness.fills import Fill
from sliplens.faithfulness.removal import Predict, removal_curves
from sliplens.progress import OnProgress


@dataclass(frozen=True, kw_only=True)
class DeletionCurves:
    """Answers of a network while pixels are removed, for several images."""

    pixels_removed: Int[np.ndarray, " steps"]
    """Pixels that are gone at each step."""
    base: Float64[np.ndarray, " images"]
    """Answer on the whole image, in margin units."""
    predictions: Float64[np.ndarray, "images steps"]
    """Answer at each step, in margin units."""
    control: "DeletionCurves | None" = None
    """The same in random order, where it was asked for: a method that does not beat it has shown nothing."""

    @property
    def scores(self) -> Float64[np.ndarray, "images steps"]:
        """Deletion score D at each step."""
        return deletion_score(self.base[:, None], self.predictions)

    @property
    def auc(self) -> Float64[np.ndarray, " images"]:
        """D_AUC of each image: the mean of D over the steps."""
        return self.scores.mean(axis=1)

    def frame(self) -> pa.Table:
        """Arrow table, a row for each image and step: pixels removed, prediction in margin units, score D."""
        images, steps = self.predictions.shape
        return pa.table(
            {
                "image": np.repeat(np.arange(images), steps),
                "pixels_removed": np.tile(self.pixels_removed, images),
                "prediction": self.predictions.ravel(),
                "score": self.scores.ravel(),
            }
        )


def deletion_score(
    base: Float[np.ndarray, "*shape"], masked: Float[np.ndarray, "*shape2"]
) -> Float[np.ndarray, "*shape3"]:
    """Deletion score D = (1 - |y_base - y_mask|)^2 of answers in margin units; lower means more was destroyed.

    References
    ----------
    Polak, eq. 2 (there in percent, hence divided by 100).

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness import deletion_score
    >>> deletion_score(np.array(0.9), np.array([0.9, 0.4])).round(2)  # nothing destroyed; half of the range
    array([1.  , 0.25])
    """
    return (1 - np.abs(base - masked)) ** 2


def deletion_order(saliency: Float[np.ndarray, "height width"]) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices from most to least salient; of ties the later pixel first, as in the thesis's masks.

    Examples
    --------
    >>> import numpy as np
    >>> from sliplens.faithfulness import deletion_order
    >>> deletion_order(np.array([[0.1, 0.9], [0.5, 0.1]]))
    array([1, 2, 3, 0])
    """
    return np.argsort(saliency.ravel(), kind="stable")[::-1].copy()


def random_order(shape: tuple[int, int], *, rng: np.random.Generator) -> Int[np.ndarray, " pixels"]:
    """Flat pixel indices in random order: the control that every explanation has to beat."""
    return rng.permutation(shape[0] * shape[1])


def deletion_steps(shape: tuple[int, int], *, steps: int | None = None) -> Int[np.ndarray, " steps"]:
    """Pixels removed at each step: as many steps as the image is high, the last of which removes all.

    References
    ----------
    Polak, section 4 (n_masks = 224 for a 224 x 224 image: 224 steps of 224 pixels).
    """
    pixels = shape[0] * shape[1]
    count = steps or shape[0]
    if not 1 <= count <= pixels:
        raise InputError(f"deletion in {count} steps is impossible with {pixels} pixels; choose 1 to {pixels}")
    return np.round(np.linspace(0, pixels, count + 1)[1:]).astype(np.int64)


def deletion_curves(
    predict: Predict,
    images: Float[Tensor, "images colours height width"],
    orders: Int[np.ndarray, "images pixels"],
    *,
    fill: Fill,
    references: Float[Tensor, "images colours height width"] | None = None,
    steps: int | None = None,
    seed: int = 0,
    batch_size: int = 128,
    on_progress: OnProgress | None = None,
) -> DeletionCurves:
    """Answers of a network while pixels are removed in one order an image (`deletion_order`, `random_order`).

    So many `steps`, the image's height if None, as in the thesis; all else is as for `removal_curves`.

    Examples
    --------
    A network that reads the mean brightness: bright pixels on black, removed one by one.

    >>> import numpy as np
    >>> import torch
    >>> from sliplens.faithfulness import deletion_curves, deletion_order, get_fill
    >>> image = torch.zeros(1, 3, 2, 2)
    >>> image[0, :, 0] = 1.0
    >>> order = deletion_order(image[0, 0].numpy())[None]
    >>> curves = deletion_curves(
    ...     lambda inputs: inputs.mean(dim=(1, 2, 3)), image, order, fill=get_fill("black"), steps=4
    ... )
    >>> curves.predictions
    array([[0.25, 0.  , 0.  , 0.  ]])
    """
    removed = deletion_steps((images.shape[-2], images.shape[-1]), steps=steps)
    curves = removal_curves(
        predict,
        images,
        orders[None],
        fill=fill,
        references=references,
        areas=[0.0, *removed / removed[-1]],
        seed=seed,
        batch_size=batch_size,
        on_progress=on_progress,
    )
    answers = curves.answers[0]
    return DeletionCurves(pixels_removed=removed, base=answers[:, 0], predictions=answers[:, 1:])


def saliency_orders(saliency: Float[np.ndarray, "images height width"], shape: tuple[int, int]) -> np.ndarray:
    """Deletion orders of several maps."""
    maps = [require_saliency(each, shape, where=f"saliency map {index}") for index, each in enumerate(saliency)]
    return np.stack([deletion_order(each) for each in maps])
