"""Scenes, LIBERO's environment around them, and replaying demonstrations in it."""

import os

from pipeline import gl

# MuJoCo reads this when it is imported, and a worker that replays may be asked to render later. One that never is can
# do without OpenGL.
if os.environ.get("MUJOCO_GL") != "disable":
    gl.choose()
