"""Scenes, LIBERO's environment around them, and replaying demonstrations in it."""

from pipeline import gl

# MuJoCo reads this when it is imported, and a worker that replays may be asked to render later.
gl.choose()
