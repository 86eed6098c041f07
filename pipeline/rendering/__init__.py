"""States to frames.

The plain path of one frame: ``Renderer.perturbed`` and ``Renderer.restore`` set up the scene, ``PlainDrawing.frame``
renders it, ``frames_of`` adds noise and turns it, ``images.jpeg.encode`` makes a JPEG file of it. ``render`` does so
for all steps and streams of a trajectory. OpenGL is chosen when the first renderer is made.
"""

from pipeline import gl

gl.import_mujoco()
