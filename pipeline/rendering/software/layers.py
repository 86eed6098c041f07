"""Rendering on a GPU that several processes share: frames in flight over underlays.

A GPU renders a face in less time than a process takes to choose it, so meshes are rendered whole. Culling and underlays
leave out whole geoms, which takes less of the processes' time.
"""

from pipeline.rendering.software.in_flight import InFlightRenderer
from pipeline.rendering.software.software_renderer import SoftwareRenderer


class LayeredRenderer(InFlightRenderer, SoftwareRenderer):
    """Rendering with frames in flight, culling and underlays, of models that are ``possible``.

    Raises:
        PipelineError: if OpenGL reports an error.
    """

    steps_ahead = 3
    chooses_faces = False
