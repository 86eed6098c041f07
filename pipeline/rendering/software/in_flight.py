"""Plain rendering with frames in flight: a GPU renders frames while the process encodes earlier frames.

The GPU copies each finished frame into a pixel buffer, which the process reads later.
"""

from collections.abc import Callable
from functools import cached_property

import mujoco
import numpy as np

from pipeline.rendering.opengl import calls, check
from pipeline.rendering.plain_renderer import PlainRenderer
from pipeline.types import Frame

BUFFERS = 8
"""Number of frames that a GPU may work on while the process does something else: four steps of two views."""


class PixelBuffers:
    """Ring of pixel buffers of the current context, into which OpenGL copies frames while the process continues.

    The copy takes the same steps as ``mjr_readPixels``: it averages the samples of each pixel, then it reads the
    averages.

    Args:
        context: MuJoCo's context.
        count: number of buffers.
        size_px: height and width of the frames.
    """

    def __init__(self, context: mujoco.MjrContext, count: int, size_px: int):
        self._context, self._size_px = context, size_px
        opengl = calls()
        self._buffers: list[int] = np.atleast_1d(opengl.glGenBuffers(count)).tolist()
        for buffer in self._buffers:
            opengl.glBindBuffer(opengl.GL_PIXEL_PACK_BUFFER, buffer)
            size = 4 * self._size_px**2
            opengl.glBufferData(opengl.GL_PIXEL_PACK_BUFFER, size, None, opengl.GL_STREAM_READ)
        opengl.glBindBuffer(opengl.GL_PIXEL_PACK_BUFFER, 0)
        self._waiting: dict[int, Frame | None] = {}
        self._started = 0

    def start_copy(self) -> int:
        """Start to copy the off-screen buffer, and return the copy's number for :meth:`take`.

        If all buffers are in use, wait for the oldest copy first.
        """
        number = self._started
        self._started += 1
        oldest = number - len(self._buffers)
        if oldest in self._waiting and self._waiting[oldest] is None:
            self._waiting[oldest] = self._read(oldest)
        opengl, context = calls(), self._context
        corners = 0, 0, self._size_px, self._size_px
        source = context.offFBO
        if context.offSamples:
            source = context.offFBO_r
            opengl.glBindFramebuffer(opengl.GL_READ_FRAMEBUFFER, context.offFBO)
            opengl.glBindFramebuffer(opengl.GL_DRAW_FRAMEBUFFER, context.offFBO_r)
            opengl.glBlitFramebuffer(*corners, *corners, opengl.GL_COLOR_BUFFER_BIT, opengl.GL_NEAREST)
        opengl.glBindFramebuffer(opengl.GL_READ_FRAMEBUFFER, source)
        opengl.glBindBuffer(opengl.GL_PIXEL_PACK_BUFFER, self._buffers[number % len(self._buffers)])
        # A whole number in place of an array is a place in the buffer. Four bytes a pixel need no conversion.
        opengl.glReadPixels(*corners, opengl.GL_RGBA, opengl.GL_UNSIGNED_BYTE, 0)
        opengl.glBindBuffer(opengl.GL_PIXEL_PACK_BUFFER, 0)
        mujoco.mjr_restoreBuffer(context)
        check("mjr_restoreBuffer")
        opengl.glFlush()
        self._waiting[number] = None
        return number

    def take(self, number: int) -> Frame:
        """Wait for a copy, and return its frame (H, W, 3) of uint8 RGB; each copy can be taken once."""
        frame = self._waiting.pop(number)
        return self._read(number) if frame is None else frame

    def _read(self, number: int) -> Frame:
        opengl = calls()
        pixels = np.empty((self._size_px, self._size_px, 4), np.uint8)
        opengl.glBindBuffer(opengl.GL_PIXEL_PACK_BUFFER, self._buffers[number % len(self._buffers)])
        opengl.glGetBufferSubData(opengl.GL_PIXEL_PACK_BUFFER, 0, pixels.nbytes, pixels)
        opengl.glBindBuffer(opengl.GL_PIXEL_PACK_BUFFER, 0)
        return np.ascontiguousarray(pixels[..., :3])


class InFlightRenderer(PlainRenderer):
    """Plain rendering whose frames are in flight between ``start_frame`` and the wait for them.

    Raises:
        PipelineError: if this machine cannot render, or OpenGL reports an error.
    """

    steps_ahead = 1

    @cached_property
    def _buffers(self) -> PixelBuffers:
        """Create the buffers in the current context."""
        return PixelBuffers(self._context, BUFFERS, self.size_px)

    def start_frame(self, data: mujoco.MjData, camera: str) -> Callable[[], Frame]:
        """Start to render a frame; see ``ModelRenderer``. Up to ``BUFFERS`` frames are in flight at a time."""
        self._gl.make_current()
        self._render_frame(data, camera)
        number = self._buffers.start_copy()

        def wait() -> Frame:
            self._gl.make_current()
            return self._buffers.take(number)

        return wait
