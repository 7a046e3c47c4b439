"""Topological maps of orchards from robot recordings, by factor graph."""

__version__ = "0.1.0"
