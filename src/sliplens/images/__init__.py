"""Tactile images: read, subtract, normalise, overlay."""

from sliplens.images.difference import absolute_difference, normalise_by_maximum
from sliplens.images.files import list_images, read_image, write_png

__all__ = ["absolute_difference", "list_images", "normalise_by_maximum", "read_image", "write_png"]
