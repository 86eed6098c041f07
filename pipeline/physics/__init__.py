"""LIBERO's environment around a scene, and the replay of demonstrations in it. No module here needs OpenGL."""

from pipeline import gl

gl.import_mujoco()
