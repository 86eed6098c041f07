"""Rendering on a GPU that several processes share: frames in flight over underlays.

A GPU renders a face in less time than a process takes to choose it, so meshes are rendered whole. Culling and underlays
leave out whole geoms, which takes less of the processes' time.
"""

from pipeline.rendering.software.drawing import SoftwareDrawing
from pipeline.rendering.software.in_flight import InFlightDrawing


class LayersDrawing(InFlightDrawing, SoftwareDrawing):
    """Rendering with frames in flight, culling and underlays, of models that are ``possible``.

    Raises:
        PipelineError: if OpenGL reports an error.
    """

    steps_ahead = 3
    chooses_faces = False
