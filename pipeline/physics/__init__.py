"""LIBERO's environment around a scene, and replaying demonstrations in it. Nothing of it needs OpenGL."""

from pipeline import gl

gl.import_mujoco()
