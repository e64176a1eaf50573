"""Recordings: trials of a tactile sensor with forces and slip labels, in memory and on disk."""

import lazy_loader

# importing the options alone, as the help of the command line does, imports no file format
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
