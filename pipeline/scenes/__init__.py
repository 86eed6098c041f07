"""Compiled scenes: places of things, and collisions. The package needs no OpenGL."""

from pipeline import gl

gl.import_mujoco()
