"""What MuJoCo 3.2.7 does with OpenGL behind its interface, used to render less and to keep what two scenes share.

This folder alone knows where MuJoCo has a geom in its memory, how it numbers its display lists, in which passes it
renders, and into which buffers. Another version may do all of that otherwise (``savings.py``).

* ``context.py``: what a context keeps from scene to scene: settings and textures.
* ``passes.py``: the passes of ``mjr_render``, and the limits that it has.
* ``meshes.py``: display lists, of which MuJoCo has two for each mesh: ``baseMesh + 2 * mesh`` for its faces, and one
  more for its convex hull.
* ``skins.py``: meshes rendered as skins, from index buffers.
* ``underlays.py``: colour and depth of the off-screen buffer, copied and put back.
"""
