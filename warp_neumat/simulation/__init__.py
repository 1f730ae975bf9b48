"""Measuring what does not exist: procedural micro-geometry, and the virtual device that photographs it."""
