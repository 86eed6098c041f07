"""Rendering of states to frames.

The plain path of one frame has four parts. ``Renderer.perturbed`` and ``Renderer.restore`` set up the scene.
``PlainRenderer.frame`` renders it. ``frames_of_steps`` adds noise and turns the frame. ``images.jpeg.encode`` encodes
it as a JPEG file. ``render`` follows this path for all steps and streams of a trajectory. OpenGL is chosen when the
first renderer is created.
"""

from pipeline import gl

gl.import_mujoco()
