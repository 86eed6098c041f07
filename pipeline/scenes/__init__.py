"""Compiled scenes: what is where, and what would collide. Nothing of it needs OpenGL."""

from pipeline import gl

gl.import_mujoco()
