"""Figures of the thesis, shown beside a workspace's own: real touch of a real sensor, so other data.

References
----------
Polak, *Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning*, Tables 1 and 2; Table 2 with
the third digit of the recorded scores, the seconds on an RTX 3060 Ti and without device synchronisation.
"""

from collections.abc import Collection

CITATION = (
    "Max Polak, Explainable Neural Networks for Incipient Slip Sensing in Robot Tactile Learning, Master's thesis, "
    "Delft University of Technology"
)
MARK = "thesis (real touch, other data)"
NETWORK_PIXELS = 224

AS_RUN = "-thesis"
"""Ends the names of the methods that are run as the thesis ran them."""


def thesis_row(method: str, among: Collection[str]) -> str | None:
    """Name the method of the thesis that one of ours stands beside; None if there is none.

    Its methods stand beside ours run as in the thesis, and beside our own only where those were not among those run.
    """
    return None if method + AS_RUN in among else method.removesuffix(AS_RUN)


ACCURACY: dict[tuple[str, str], tuple[float, float]] = {
    ("raw", "dry"): (1.87e-2, 0.85),
    ("raw", "wet"): (5.07e-2, 0.57),
    ("difference", "dry"): (1.44e-2, 0.89),
    ("difference", "wet"): (4.02e-2, 0.66),
}
"""MSE in squared margin units and R2, by input and condition."""

DELETION: dict[tuple[str, str], tuple[float, float]] = {
    ("difference", "grad-cam"): (0.325, 0.106),
    ("difference", "integrated-gradients"): (0.272, 0.158),
    ("difference", "poly-cam"): (0.200, 0.146),
    ("raw", "grad-cam"): (0.539, 0.101),
    ("raw", "integrated-gradients"): (0.677, 0.118),
    ("raw", "poly-cam"): (0.512, 0.203),
}
"""Mean and standard deviation of D_AUC, by input and method."""

SECONDS: dict[str, float] = {"grad-cam": 0.029, "integrated-gradients": 0.27, "poly-cam": 4.9}
"""Seconds an image, by method."""
