"""States to frames. What renders is chosen when the first renderer is made."""

from pipeline import gl

gl.import_mujoco()
