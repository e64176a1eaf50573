"""Poly-CAM re-derived slowly, one mask at a time, as the paper's steps go and as its public code ran them."""

from functools import lru_cache

import numpy as np
import torch
from torch import nn

from sliplens.explainers.cam import capture


@lru_cache
def matrix_of_bilinear(cells: int, pixels: int) -> np.ndarray:
    """Row p holds the weights of pixel p: centres at (p + 1/2) cells / pixels, clamped at the border."""
    weights = np.zeros((pixels, cells))
    for pixel in range(pixels):
        place = min(max((pixel + 0.5) * cells / pixels - 0.5, 0), cells - 1)
        below = int(np.floor(place))
        above = min(below + 1, cells - 1)
        weights[pixel, below] += 1 - (place - below)
        weights[pixel, above] += place - below
    return weights


def resize(cells: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    rows, columns = (matrix_of_bilinear(n, m) for n, m in zip(cells.shape, size, strict=True))
    return rows @ cells @ columns.T


def mask_of(cells: np.ndarray, *, published: bool) -> np.ndarray:
    low, high = np.quantile(cells, [0.001, 0.999])
    if high < 0 and not published:
        return np.zeros_like(cells)
    return np.clip((cells - low) / max(high, 1e-12), 0, 1)


def by_hand(model: nn.Module, image, reference, *, layers: tuple[str, ...], published: bool = False) -> np.ndarray:
    """Steps 1 to 5 for one image with the regression score or that of the public code; the finest saliency."""

    def predict(tensor) -> float:
        with torch.no_grad():
            output = model(tensor[None]).squeeze()
            return float(torch.sigmoid(100 * output) if published else output)

    size = tuple(image.shape[1:])
    with capture(model, layers) as outputs:
        prediction = predict(image)
    base = predict(reference)
    layer_maps = []
    for name in layers:
        total = 0
        for activation in outputs[name][0].numpy():
            mask = torch.from_numpy(resize(mask_of(activation, published=published), size)).to(image.dtype)
            kept = predict(reference + (image - reference) * mask)
            lost = prediction - predict(reference + (image - reference) * (1 - mask))
            support = kept + lost if published else np.sign(prediction - base) * (kept - base + lost) / 2
            total = total + max(support, 0) * activation
        layer_maps.append(np.maximum(total, 0))
    result = layer_maps[-1]
    for layer_map in reversed(layer_maps[:-1]):
        smooth = resize(resize(layer_map, result.shape), layer_map.shape)
        result = np.maximum(layer_map / np.maximum(smooth, 1e-12) * resize(result, layer_map.shape), 0)
    saliency = resize(mask_of(result, published=published), size)
    return saliency if published else saliency * changed(image, reference)


def changed(image, reference) -> np.ndarray:
    """Mean difference over a square of 15 of 224 pixels, the outermost ones repeated."""
    difference = np.abs(image.numpy() - reference.numpy()).mean(axis=0)
    height, width = difference.shape
    reach = round(15 / 224 * height) // 2
    mean = np.zeros_like(difference)
    for row in range(height):
        for column in range(width):
            rows = np.clip(np.arange(row - reach, row + reach + 1), 0, height - 1)
            columns = np.clip(np.arange(column - reach, column + reach + 1), 0, width - 1)
            mean[row, column] = difference[np.ix_(rows, columns)].mean()
    return mean
