"""Relit: photographs of an object into a 3D asset that can be relit."""

__version__ = "0.1.0"
