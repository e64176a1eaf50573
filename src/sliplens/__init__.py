"""sliplens: how close a soft fingertip is to losing its grip, from its camera images, and why the network says so."""

import lazy_loader

# names and their modules stand in `__init__.pyi`: importing sliplens alone imports neither torch nor NumPy
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
