"""A loaded fingertip filmed: the reference frame and the frames of a trial."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from sliplens.mechanics import normal_slope
from sliplens.simulation.geometry import pixel_grid
from sliplens.simulation.loading import Loading
from sliplens.simulation.motion import Motion, move_markers
from sliplens.simulation.nuisances import Day, Grasp, Unit
from sliplens.simulation.rendering import Scene, View, brightness, draw_texture, empty_view, haze, relief, render
from sliplens.simulation.sensor import DrawnMarkers, Noise, NoisePicks, Sensor, draw_look, pick_noise

_BATCHES = {"cpu": 4, "cuda": 512}
"""Frames drawn at once: few enough for a processor's caches, many enough for a GPU."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """A trial ready to be drawn, any of its frames in any order; made by `prepare_film`."""

    sensor: Sensor
    grasp: Grasp
    day: Day
    unit: Unit
    motion: Motion
    noise: Noise | None
    marker_rest_px: Float[np.ndarray, "markers 2"]
    """Untouched markers as the camera sees them, with the jitter of the print and the seat of the camera."""
    marker_px: Float[np.ndarray, "frames markers 2"]
    blur_px: Float[np.ndarray, " frames_and_reference"]
    """Blur of the untouched sensor, then of each frame, as in the picks."""
    noise_picks: NoisePicks
    view: View
    rays: Float[np.ndarray, "height width 2"]

    def __len__(self) -> int:
        return len(self.marker_px)

    def draw_reference(self, *, device: str | torch.device = "cpu") -> UInt8[Tensor, "height width 3"]:
        """Draw the untouched sensor."""
        slope = None if self.view.relief is None else np.zeros((1, *self.rays.shape[:2]), dtype=np.float32)
        return self._draw(
            self.marker_rest_px[None],
            self.look_at_rest(),
            touch=np.zeros(1),
            slope=slope,
            taken=slice(0, 1),
            device=device,
        )[0]

    def draw(self, frames: slice, *, device: str | torch.device = "cpu") -> UInt8[Tensor, "frames height width 3"]:
        """Draw some of the frames."""
        slope = None
        if self.view.relief is not None:
            slope = np.asarray(
                normal_slope(
                    np.sqrt(self._face_distance_squared(frames)),
                    contact_radius_m=self.motion.contact_radius_m[frames, None, None],
                    sphere_radius_m=self.sensor.geometry.sphere_radius_m,
                ),
                dtype=np.float32,
            )
        return self._draw(
            self.marker_px[frames],
            self.look(frames),
            touch=self.motion.touch[frames],
            slope=slope,
            taken=slice(frames.start + 1, frames.stop + 1),
            device=device,
        )

    def look_at_rest(self) -> DrawnMarkers:
        """Look of the untouched sensor's markers."""
        ones = np.ones((1, len(self.marker_rest_px)))
        return self._look(ones, 0 * ones, np.zeros(1), slice(0, 1))

    def look(self, frames: slice) -> DrawnMarkers:
        """Look of the markers in some of the frames."""
        motion, taken = self.motion, slice(frames.start + 1, frames.stop + 1)
        return self._look(motion.scale[frames], motion.pressure[frames], motion.touch[frames], taken)

    def _look(self, scale: np.ndarray, pressure: np.ndarray, touch: np.ndarray, taken: slice) -> DrawnMarkers:
        return draw_look(
            self.sensor.look,
            geometry=self.sensor.geometry,
            unit=self.unit,
            scale=scale,
            pressure=pressure,
            touch=touch,
            blur_px=self.blur_px[taken],
        )

    def contact_map(self, frames: slice) -> UInt8[np.ndarray, "frames height width"]:
        """Map of the contact as the camera sees it: 0 outside, 1 slipping, 2 sticking.

        The contact of a dome is seen as the flat lens that it is, displaced and enlarged by its indentation.
        """
        square = self._face_distance_squared(frames)
        touching = square < (self.motion.contact_radius_m[frames, None, None] ** 2).astype(np.float32)
        sticking = square < (self.motion.stick_radius_m[frames, None, None] ** 2).astype(np.float32)
        return touching.view(np.uint8) + sticking.view(np.uint8)

    def _face_distance_squared(self, frames: slice) -> Float32[np.ndarray, "frames height width"]:
        return self.sensor.geometry.face_distance_squared(
            self.rays, contact_centre_m=self.motion.contact_centre_m, indentation_m=self.motion.indentation_m[frames]
        )

    def _draw(
        self,
        centres_px: Float[np.ndarray, "frames markers 2"],
        markers: DrawnMarkers,
        *,
        touch: Float[np.ndarray, " frames"],
        slope: Float32[np.ndarray, "frames height width"] | None,
        taken: slice,
        device: str | torch.device,
    ) -> UInt8[Tensor, "frames height width 3"]:
        picks = self.noise_picks.at(taken)
        scene = Scene(view=self.view, centres_px=centres_px, markers=markers, touch=touch, slope=slope, noise=picks)
        return render(scene, sensor=self.sensor, noise=self.noise, device=device)


@dataclass(frozen=True, kw_only=True)
class _Seat:
    """Seat of the camera on its day: turned about the image of the skin's middle, and shifted."""

    day: Day
    middle: Float[np.ndarray, "2"]

    def see(self, points_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of this camera for pixels of one that sits as drawn."""
        return (points_px - self.middle) @ self._turn() + self.middle + np.asarray(self.day.camera_shift_px)

    def unsee(self, points_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of a camera that sits as drawn for pixels of this one: the inverse of `see`."""
        return (points_px - self.middle - np.asarray(self.day.camera_shift_px)) @ self._turn().T + self.middle

    def _turn(self) -> Float[np.ndarray, "2 2"]:
        cos, sin = np.cos(self.day.camera_rotation_rad), np.sin(self.day.camera_rotation_rad)
        return np.array([[cos, sin], [-sin, cos]])


def batches(frames: int, *, device: str | torch.device) -> Iterator[slice]:
    """Cut a trial into batches that suit a device; the frames do not depend on it."""
    step = _BATCHES.get(torch.device(device).type, 64)
    return (slice(start, min(start + step, frames)) for start in range(0, frames, step))


def prepare_film(
    sensor: Sensor,
    *,
    loading: Loading,
    grasp: Grasp,
    day: Day,
    unit: Unit,
    rng: np.random.Generator,
    noise: Noise | None,
    displacement: str | None = None,
) -> Film:
    """Move the markers, set the light and draw all that is random: what is left is drawing.

    `noise`: the camera's noise; None films without it.
    """
    motion = move_markers(
        sensor,
        loading=loading,
        grasp=grasp,
        displacement=displacement,
        modulus_factor=day.modulus_factor,
        marker_depth=unit.marker_depth,
    )
    geometry, frames = sensor.geometry, len(loading.time_s)
    seat = _Seat(day=day, middle=np.asarray(geometry.centre_px))
    contact_px = seat.see(geometry.project(geometry.skin_point(motion.contact_centre_m)))
    edge, apex = (geometry.project(geometry.skin_point(np.array([x, 0.0]))) for x in (motion.nominal_radius_m, 0.0))
    light = brightness(sensor, day=day)
    grain = np.random.default_rng((unit.texture_seed, 1))
    view = View(
        texture=draw_texture(geometry.markers, rng=np.random.default_rng(unit.texture_seed)),
        light=light,
        empty=empty_view(sensor, day=day, light=light),
        haze=haze(sensor, grasp=grasp, contact_px=contact_px, radius_px=float(edge[0] - apex[0]), rng=grain),
        relief=relief(sensor, contact_px=contact_px),
    )
    return Film(
        sensor=sensor,
        grasp=grasp,
        day=day,
        unit=unit,
        motion=motion,
        noise=noise,
        marker_rest_px=seat.see(motion.rest_px + unit.marker_jitter_px),
        marker_px=seat.see(motion.centres_px + unit.marker_jitter_px),
        # drawn before the noise, so that a clean film differs in its noise alone
        blur_px=grasp.blur_px * rng.uniform(0.8, 1.2, frames + 1),
        noise_picks=pick_noise(frames + 1, rng=rng),
        view=view,
        rays=geometry.rays(seat.unsee(pixel_grid(sensor.image_size_px))),
    )
