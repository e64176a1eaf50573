import tracemalloc
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from sliplens.errors import RecordingError
from sliplens.recordings.importing import choose_reference

SIZE = 84


class Film:
    """Untouched at both ends, touched between; a hand shakes the first frames, the touch leaves its rim in one."""

    def __init__(self) -> None:
        rng = np.random.default_rng(5)
        skin = np.kron(rng.integers(60, 120, (28, 28, 1)), np.ones((3, 3, 3))).astype(np.float64)
        self.untouched = np.array([True] * 8 + [False] * 6 + [True] * 6)
        self.frames = np.empty((20, SIZE, SIZE, 3), dtype=np.uint8)
        for index in range(20):
            image = skin + rng.normal(0, 2, skin.shape)
            if index < 2:
                image = np.roll(image, 6 * (index + 1), axis=1)
            if index in range(6, 14):
                image[20 : 20 + 4 * (index - 4), 30:40] += 60
            if index == 3:
                image += 12  # a flicker of the lamp
            self.frames[index] = image.round().clip(0, 255)

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        return (self.frames[place % 20] for place in places)


def test_the_least_energy_is_neither_shaken_nor_touched():
    film = Film()
    reference = choose_reference(film.read, film.untouched)
    assert reference.index in {2, 3, 4, 5}
    assert reference.method == "least contact energy"


def test_brightness_alone_is_no_contact():
    film = Film()
    places = [2, 4, 12, 3, 5]
    for place, brighter in zip(places, (-20, -10, 0, 0, 24), strict=True):  # the touched frame is of median brightness
        film.frames[place] = (film.frames[place].astype(int) + brighter).clip(0, 255)
    read = lambda numbers: film.frames[[places[number] for number in numbers]]  # noqa: E731
    assert choose_reference(read, np.ones(5, dtype=bool)).index != places.index(12)


def test_memory_does_not_grow_with_the_untouched_stretch():
    film = Film()

    def peak(count: int) -> int:
        tracemalloc.start()
        choose_reference(film.read, np.ones(count, dtype=bool))
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(400)  # what is made once only
    # two hundred frames are compared of either; 3,600 more softened frames of 9 kB would be 34 MB
    assert peak(4000) < peak(400) + 1e6


def test_a_named_frame_may_touch_and_a_recording_that_begins_pressed_has_its_reference_after_that():
    film = Film()
    reference = choose_reference(film.read, film.untouched, index=10)
    assert (reference.index, reference.method) == (10, "named")
    film.untouched[:8] = False
    assert (choose_reference(film.read, film.untouched).index or 0) >= 14


def test_no_untouched_frame_is_refused():
    film = Film()
    film.untouched[:] = False
    with pytest.raises(RecordingError, match="no frame is known to be untouched; name the reference frame by hand"):
        choose_reference(film.read, film.untouched)
    assert choose_reference(film.read, film.untouched, index=0).index == 0
