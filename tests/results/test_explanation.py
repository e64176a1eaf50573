import numpy as np
import pytest

from sliplens.errors import SaliencyError
from sliplens.results.explanation import require_saliency


def test_a_map_that_fits_passes_unchanged():
    saliency = np.eye(3)
    assert require_saliency(saliency, (3, 3)) is saliency


def test_a_map_of_another_shape_is_refused():
    with pytest.raises(SaliencyError, match=r"the saliency map has shape \(3, 4\) but its image is 4 x 4 pixels"):
        require_saliency(np.zeros((3, 4)), (4, 4))


def test_nan_in_a_map_is_refused():
    saliency = np.zeros((2, 2))
    saliency[0, 1] = np.nan
    with pytest.raises(SaliencyError, match="map 7 holds NaN or infinity in 1 of 4 pixels"):
        require_saliency(saliency, (2, 2), where="map 7")
