"""Internals of MuJoCo 3.2.7's rendering by OpenGL, used to render less and to keep the shared parts of two scenes.

Only this folder relies on MuJoCo's memory layout of geoms, its numbering of display lists, its passes and its buffers.
All of these may differ in another version (``savings.py``).

* ``context.py``: the parts of a context that are kept from scene to scene: settings and textures.
* ``passes.py``: the passes of ``mjr_render``, and its limits.
* ``meshes.py``: display lists. MuJoCo has two for each mesh: ``baseMesh + 2 * mesh`` for its faces, and the next number
  for its convex hull.
* ``skins.py``: meshes rendered as skins, from index buffers.
* ``underlays.py``: colour and depth of the off-screen buffer, copied and put back.
"""
