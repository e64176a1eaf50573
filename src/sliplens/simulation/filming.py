"""Rendering of a loaded fingertip: light, reference frame and the frames of a trial."""

from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from sliplens.mechanics import normal_slope
from sliplens.simulation.loading import Loading, Motion, load_at_margins, move_markers
from sliplens.simulation.nuisances import Day, Grasp, Nuisances, Unit
from sliplens.simulation.sensor import Point, Rays, Sensor, mix_noise, pick_noise, pixel_grid

Planes: TypeAlias = Float32[np.ndarray, "3 height width"]
Looks: TypeAlias = Float[np.ndarray, "frames markers 3"]

_BATCH = 4  # frames drawn at once: few enough for a processor's caches
_PATCH = 32  # side of the square in which a marker is drawn, in pixels: the edge of the widest marker fades within it
_WHITE = 258.0  # level that glare is limited to, a little above white: markers in it show, noise does not
_GRAIN_PX = 2.2  # size of the pressed skin's grain
_GLOW_RADIUS = 0.935  # radius at which the glow of the contact fades, over that of a nominal contact


@dataclass(frozen=True, kw_only=True)
class Film:
    """Trial whose frames can be drawn in any order; made by `prepare_film`."""

    sensor: Sensor
    grasp: Grasp
    day: Day
    unit: Unit
    motion: Motion
    marker_rest_px: Float[np.ndarray, "markers 2"]
    """Untouched markers in the camera's image, with the jitter of the print and the camera's pose."""
    marker_px: Float[np.ndarray, "frames markers 2"]
    blur_px: Float[np.ndarray, " frames_and_reference"]
    """Blur of the untouched sensor, then of each frame."""
    noise_picks: Int[np.ndarray, "frames_and_reference 2 3"]
    """See `pick_noise`."""
    rays: Rays
    texture: Float32[np.ndarray, "3 markers side side"]
    """Grain of the print, of unit strength."""
    light: Planes
    """Brightness over the sensor's."""
    empty: Planes
    """Untouched sensor without its markers, in grey levels."""
    haze: Planes
    """Grey levels that full contact adds."""
    relief: Planes | None
    """Relative change of brightness where the skin slopes by 1; None for a sensor without lamps."""

    def __len__(self) -> int:
        return len(self.marker_px)

    def untouched(self) -> "Film":
        """Return a film of the reference frame alone."""
        first, nothing = np.zeros(2, dtype=int), load_at_margins(np.full(1, np.nan), grasp=self.grasp)
        return self._loaded(nothing, blur_px=self.blur_px[first], noise_picks=self.noise_picks[first])

    def under(self, loading: Loading, *, rng: np.random.Generator) -> "Film":
        """Return a film of another loading of the same grasp, by the same camera on the same day, with new noise.

        The markers move by the sensor's default model; the grasp's offset, direction and haze stay.
        """
        frames = len(loading.time_s)
        blur_px = np.append(self.blur_px[:1], np.full(frames, self.grasp.blur_px))
        return self._loaded(
            loading, blur_px=blur_px, noise_picks=np.concatenate([self.noise_picks[:1], pick_noise(frames, rng=rng)])
        )

    def _loaded(self, loading: Loading, **drawn: np.ndarray) -> "Film":
        motion, _, marker_px = see_markers(self.sensor, loading=loading, grasp=self.grasp, day=self.day, unit=self.unit)
        return replace(self, motion=motion, marker_px=marker_px, **drawn)

    def draw_reference(self) -> UInt8[Tensor, "height width 3"]:
        """Draw the untouched sensor."""
        return self.untouched().draw(slice(0, 1))[0]

    def draw(self, frames: slice) -> UInt8[Tensor, "frames height width 3"]:
        """Draw some of the frames; a frame does not depend on those drawn with it.

        Each marker is drawn in a small patch and added to the frame, so that a frame costs little more than its noise.
        """
        # one plane a channel: constants of a channel apply to whole rows of pixels, which vectorises
        sensor, motion, shade = self.sensor, self.motion, self._shade(frames)
        noise = sensor.noise
        contrast = _tensor(self.light)[:, None] * _channels(sensor.look.contrast)
        planes = torch.addcmul(_tensor(self.empty)[:, None], shade, contrast, value=-1)
        if self.relief is not None:
            slope = normal_slope(
                np.sqrt(self._face_distance_squared(frames)),
                contact_radius_m=motion.contact_radius_m[frames, None, None],
                sphere_radius_m=sensor.geometry.sphere_radius_m,
            )
            planes *= 1 + _tensor(np.asarray(slope)) * _tensor(self.relief)[:, None]
        planes.addcmul_(_tensor(motion.touch[frames])[:, None, None], _tensor(self.haze)[:, None])
        background = _channels(noise.background)
        excess, share = _channels(noise.marker) - background, shade.clamp_(0, 1)
        strength = torch.addcmul((1 + noise.edge) * excess, share, noise.edge * excess, value=-1)
        strength.mul_(share).add_(background)
        picks = self.noise_picks[frames.start + 1 : frames.stop + 1]
        planes.addcmul_(strength, mix_noise(picks, noise=noise, image_size_px=sensor.image_size_px))
        planes.add_(0.5).clamp_(0, 255)
        pixels = torch.empty((*planes.shape[1:], 3), dtype=torch.uint8)
        for channel, plane in enumerate(planes):  # converts and interleaves in one go
            pixels[..., channel].copy_(plane)
        return pixels

    def look(self, frames: slice) -> tuple[Looks, Looks, Looks]:
        """Compute radius and edge width in pixels, and contrast over the sensor's, of the markers in some frames.

        A pressed marker is paler, for the object behind the thin skin throws light back, and it is sharp: pressing
        brings the gel into the focus that the untouched one is out of, most in red and to one side of the image.
        Markers seen aslant are paler, too.
        """
        look, geometry, motion, unit = self.sensor.look, self.sensor.geometry, self.motion, self.unit
        rest = geometry.marker_positions()
        aslant = 1 - geometry.slope_cosine(rest)[:, None] ** 2
        pressed = np.minimum(motion.touch[frames], 1)[:, None, None]
        tilt = np.maximum(1 + rest[:, :2] @ np.asarray(look.focus_tilt) / geometry.sphere_radius_m, 0)
        defocus = (1 - pressed) * tilt[:, None] * np.asarray(look.defocus_px)
        # the standard deviation of a logistic edge is 1.81 widths
        blur = self.blur_px[frames.start + 1 : frames.stop + 1, None, None] / 1.81
        size = geometry.marker_scale() * unit.radius_factor * motion.scale[frames]
        squeezed = 1 + motion.pressure[frames][..., None] * np.asarray(look.squeeze)
        slanted = unit.contrast_factor[:, None] * (1 - np.asarray(look.aslant_fade) * aslant)
        return (
            size[..., None] * squeezed * np.asarray(look.radius_px),
            np.sqrt(np.asarray(look.edge_px) ** 2 + defocus**2 + blur**2),
            slanted * (1 - np.asarray(look.pressed_fade) * pressed),
        )

    def outlines(self, frame: int | None) -> tuple[Float[np.ndarray, "markers 2"], Float[np.ndarray, " markers"]]:
        """Compute centres and radii, in pixels of the camera, of the circles that the markers fill; None: at rest."""
        if frame is None:
            return self.untouched().outlines(0)
        return self.marker_px[frame], self.look(slice(frame, frame + 1))[0][0].max(axis=-1)

    def draw_all(self) -> UInt8[np.ndarray, "frames height width 3"]:
        """Draw every frame."""
        return torch.cat([self.draw(part) for part in batches(len(self))]).numpy()

    def contact_map(self, frames: slice) -> UInt8[np.ndarray, "frames height width"]:
        """Compute the contact in the camera's image: 0 outside, 1 slipping, 2 sticking.

        The contact of a dome is flat, displaced and enlarged by its indentation.
        """
        square = self._face_distance_squared(frames)
        touching = square < (self.motion.contact_radius_m[frames, None, None] ** 2).astype(np.float32)
        sticking = square < (self.motion.stick_radius_m[frames, None, None] ** 2).astype(np.float32)
        return touching.view(np.uint8) + sticking.view(np.uint8)

    def _face_distance_squared(self, frames: slice) -> Float32[np.ndarray, "frames height width"]:
        return self.sensor.geometry.face_distance_squared(
            self.rays, contact_centre_m=self.motion.contact_centre_m, indentation_m=self.motion.indentation_m[frames]
        )

    def _shade(self, frames: slice) -> Float[Tensor, "3 frames height width"]:
        """Compute the share of the markers' contrast in each pixel: 0 in the background, about 1 in a marker."""
        centres_px, noise, size_px = self.marker_px[frames], self.sensor.noise, self.sensor.image_size_px
        inside = np.all((centres_px > -_PATCH / 2) & (centres_px < size_px - 1 + _PATCH / 2), axis=-1)
        frame_index, marker_index = np.nonzero(inside)
        centres = _tensor(centres_px[inside])
        radius, edge, contrast = (
            _tensor(values[inside]).T[:, :, None, None].contiguous() for values in self.look(frames)
        )
        corner = torch.floor(centres).to(torch.int64) - _PATCH // 2 + 1

        steps = torch.arange(_PATCH)
        dx, dy = (corner[:, axis, None] + steps - centres[:, axis, None] for axis in (0, 1))
        distance = torch.sqrt(dy.square()[:, :, None] + dx.square()[:, None, :])
        texture = _tensor(self.texture)[:, torch.as_tensor(marker_index)]
        patch = texture * _channels(noise.ragged_px)
        patch.add_(radius).sub_(distance).div_(edge).sigmoid_()
        patch.mul_(texture.mul_(_channels(noise.grain)).add_(1))
        patch.mul_(contrast)
        # the padding takes what sticks out; one patch after another is several times faster than a single sum
        side = size_px + 2 * _PATCH
        canvas = np.zeros((3, len(centres_px), side, side), dtype=np.float32)
        for item, (index, (x, y)) in enumerate(zip(frame_index.tolist(), (corner + _PATCH).tolist(), strict=True)):
            canvas[:, index, y : y + _PATCH, x : x + _PATCH] += patch.numpy()[:, item]
        return torch.from_numpy(canvas)[:, :, _PATCH:-_PATCH, _PATCH:-_PATCH]


def batches(frames: int) -> list[slice]:
    """Cut a trial into batches; the frames do not depend on it."""
    return [slice(start, min(start + _BATCH, frames)) for start in range(0, frames, _BATCH)]


def prepare_film(
    sensor: Sensor,
    *,
    loading: Loading,
    grasp: Grasp,
    day: Day,
    unit: Unit,
    rng: np.random.Generator,
    displacement: str | None = None,
) -> Film:
    """Move the markers, set the light and draw all random numbers of a trial."""
    motion, rest_px, marker_px = see_markers(
        sensor, loading=loading, grasp=grasp, day=day, unit=unit, displacement=displacement
    )
    geometry, frames = sensor.geometry, len(loading.time_s)
    middle = np.asarray(geometry.centre_px)
    contact_px = _see(geometry.project(geometry.skin_point(motion.contact_centre_m)), centre_px=middle, day=day)
    edge, apex = (geometry.project(geometry.skin_point(np.array([x, 0.0]))) for x in (motion.nominal_radius_m, 0.0))
    light, grain = brightness(sensor, day=day), np.random.default_rng((unit.texture_seed, 1))
    print_shape = (3, geometry.markers, _PATCH, _PATCH)
    texture = np.random.default_rng(unit.texture_seed).standard_normal(print_shape, dtype=np.float32)
    texture[1] = 0.5 * texture[0] + 0.75**0.5 * texture[1]  # red and green are half correlated
    return Film(
        sensor=sensor,
        grasp=grasp,
        day=day,
        unit=unit,
        motion=motion,
        marker_rest_px=rest_px,
        marker_px=marker_px,
        blur_px=grasp.blur_px * rng.uniform(0.8, 1.2, frames + 1),
        noise_picks=pick_noise(frames + 1, rng=rng),
        rays=geometry.rays(
            (pixel_grid(sensor.image_size_px) - middle - np.asarray(day.camera_shift_px)) @ _turn(day).T + middle
        ),
        texture=texture,
        light=light,
        empty=empty_view(sensor, day=day, light=light),
        haze=haze(sensor, grasp=grasp, contact_px=contact_px, radius_px=float(edge[0] - apex[0]), rng=grain),
        relief=relief(sensor, contact_px=contact_px),
    )


def see_markers(
    sensor: Sensor, *, loading: Loading, grasp: Grasp, day: Day, unit: Unit, displacement: str | None = None
) -> tuple[Motion, Float[np.ndarray, "markers 2"], Float[np.ndarray, "frames markers 2"]]:
    """Compute the motion, and the markers' places (pixels, x and y) in the image at rest and in each frame."""
    grasp = replace(grasp, modulus_factor=day.modulus_factor, marker_depth=unit.marker_depth)
    motion = move_markers(sensor, grasp, loading=loading, displacement=displacement)
    see = partial(_see, centre_px=np.asarray(sensor.geometry.centre_px), day=day)
    return motion, see(motion.rest_px + unit.marker_jitter_px), see(motion.centres_px + unit.marker_jitter_px)


def _turn(day: Day) -> Float[np.ndarray, "2 2"]:
    cos, sin = np.cos(day.camera_rotation_rad), np.sin(day.camera_rotation_rad)
    return np.array([[cos, sin], [-sin, cos]])


def _see(points_px: Float[np.ndarray, "*batch 2"], *, centre_px: Point, day: Day) -> Float[np.ndarray, "*batch 2"]:
    """Turn points about the image of the skin's middle, and shift them, as the day's camera does."""
    return (points_px - centre_px) @ _turn(day) + centre_px + np.asarray(day.camera_shift_px)


def move_camera(film: Film, nuisances: Nuisances, *, rng: np.random.Generator) -> Film:
    """Turn and magnify the markers of each frame about the middle of the image, against the reference frame.

    Ranges are `frame_turn_deg` and `frame_zoom` of the nuisances. Skin, light and contact stay: they vary slowly.
    """
    if nuisances.frame_turn_deg == (0.0, 0.0) and nuisances.frame_zoom == (1.0, 1.0):
        return film
    frames, middle = len(film), np.asarray(film.sensor.geometry.centre_px)
    turn = np.radians(rng.uniform(*nuisances.frame_turn_deg, size=frames))[:, None]
    zoom = rng.uniform(*nuisances.frame_zoom, size=frames)[:, None]
    x, y = np.moveaxis(film.marker_px - middle, -1, 0)
    moved = zoom[..., None] * np.stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], -1)
    return replace(film, marker_px=moved + middle)


def brightness(sensor: Sensor, *, day: Day) -> Planes:
    """Compute the brightness of the untouched skin over the sensor's background.

    Gain, white balance, vignette, lamps, and a linear fall of brightness across the image.
    """
    x, y = np.moveaxis(pixel_grid(sensor.image_size_px) / (sensor.image_size_px - 1) - 0.5, -1, 0)
    cos, sin = np.cos(day.gradient_direction_rad), np.sin(day.gradient_direction_rad)
    # the brightest corner keeps its level
    fall = 1 - day.gradient * (0.5 - (x * cos + y * sin) / (abs(cos) + abs(sin)))
    corner = 1 - sensor.vignette * 2 * (x**2 + y**2)
    even = day.gain * (fall * corner)[..., None] * np.asarray(day.white_balance)
    for lamp in sensor.lights:
        towards = 2 * (x * np.cos(np.radians(lamp.direction_deg)) + y * np.sin(np.radians(lamp.direction_deg)))
        even = even * (1 + lamp.fall * towards[..., None] * np.asarray(lamp.share))
    return _planes(even)


def empty_view(sensor: Sensor, *, day: Day, light: Planes) -> Planes:
    """Compute the untouched sensor without markers, with the glare of the lamps, in grey levels."""
    skin = np.asarray(sensor.background, dtype=np.float32)[:, None, None] * light
    glare = sensor.glare
    if glare is None:
        return skin
    bearings = np.radians(glare.bearing_deg) + 2 * np.pi * np.arange(glare.lamps) / glare.lamps
    lamps = np.asarray(glare.centre_px) + glare.radius_px * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    away = ((pixel_grid(sensor.image_size_px)[:, :, None] - lamps) ** 2).sum(axis=-1)
    spots = np.exp(-away / (2 * glare.width_px**2)).sum(axis=-1)
    return np.minimum(skin + _planes(day.glare * spots[..., None] * np.asarray(glare.colour)), np.float32(_WHITE))


def relief(sensor: Sensor, *, contact_px: Point) -> Planes | None:
    """Compute the relative change of brightness where skin slopes by 1 away from a contact; None without lamps.

    The dent is a hill to the camera inside: its flank towards a lamp brightens.
    """
    if not sensor.lights:
        return None
    away = pixel_grid(sensor.image_size_px) - contact_px
    bearing = np.arctan2(away[..., 1], away[..., 0])
    lamps = [
        lamp.relief * np.cos(bearing - np.radians(lamp.direction_deg))[..., None] * np.asarray(lamp.share)
        for lamp in sensor.lights
    ]
    return _planes(np.sum(lamps, axis=0))


def haze(sensor: Sensor, *, grasp: Grasp, contact_px: Point, radius_px: float, rng: np.random.Generator) -> Planes:
    """Compute the grey levels that full contact adds: a veil, a glow where the object reflects light, skin grain.

    `contact_px` and `radius_px` are the contact's centre and its radius in a nominal grasp, in the image.
    """
    if not sensor.sees_contact:
        return np.zeros((3, sensor.image_size_px, sensor.image_size_px), dtype=np.float32)
    square = ((pixel_grid(sensor.image_size_px) - contact_px) ** 2).sum(axis=-1)
    disc = np.exp(-((square / (_GLOW_RADIUS * radius_px) ** 2) ** 2))
    # noise of unit variance, correlated over a few pixels
    steps, size = np.arange(-8, 9), sensor.image_size_px + 16
    kernel = np.exp(-(steps**2) / (2 * _GRAIN_PX**2))
    kernel /= np.linalg.norm(kernel)
    windows = np.lib.stride_tricks.sliding_window_view
    rows = windows(rng.standard_normal((size, size)), len(kernel), axis=1) @ kernel
    grain = grasp.skin_grain * (windows(rows, len(kernel), axis=0) @ kernel)
    return _planes(np.asarray(grasp.veil) + disc[..., None] * np.asarray(grasp.glow) + grain[..., None])


def _planes(image: Float[np.ndarray, "height width 3"]) -> Planes:
    return np.ascontiguousarray(np.moveaxis(image, -1, 0), dtype=np.float32)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


def _channels(values: tuple[float, float, float]) -> Float[Tensor, "3 1 1 1"]:
    return torch.tensor(values, dtype=torch.float32).reshape(3, 1, 1, 1)
