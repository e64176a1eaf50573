"""Markers are found with OpenCV, of the extra `markers`: without it these tests are skipped."""

import pytest

pytest.importorskip("cv2", reason="markers are found with OpenCV, of the extra `markers`")
