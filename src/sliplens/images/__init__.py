"""Tactile images: read, write, subtract."""

from sliplens.images.difference import absolute_difference, signed_difference
from sliplens.images.files import list_images, read_image, write_png

__all__ = ["absolute_difference", "list_images", "read_image", "signed_difference", "write_png"]
