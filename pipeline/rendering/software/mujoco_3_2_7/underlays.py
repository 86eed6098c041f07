"""Colour and depth of MuJoCo 3.2.7's off-screen buffer, copied and put back."""

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

from pipeline.rendering.opengl import calls, failure


@contextmanager
def recorded(number: int) -> Iterator[None]:
    """Record OpenGL's commands into a display list instead of executing them."""
    calls().glNewList(number, calls().GL_COMPILE)
    try:
        yield
    finally:
        calls().glEndList()


_VERTICES = "#version 400 compatibility\nvoid main() { gl_Position = gl_Vertex; }"

# The far end of MuJoCo's depth is 0. Samples with this depth show no geom, only the sky, which every picture renders.
_SAMPLES = """#version 400 compatibility
uniform sampler2DMS colours, depths;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float depth = texelFetch(depths, pixel, gl_SampleID).r;
    if (depth == 0.0) discard;
    gl_FragColor = texelFetch(colours, pixel, gl_SampleID);
    gl_FragDepth = depth;
}
"""


class Underlay:
    """Part of a picture that is rendered once and used in many pictures: colour and depth of every sample.

    The context must be the current context. Pictures begin in the corner of its off-screen buffer.

    Attributes:
        number: number of the display list that writes the underlay into the off-screen buffer. It writes only samples
            at which no nearer geom was rendered; at equal depth the underlay wins (``ties``). MuJoCo calls the list
            after all opaque geoms (``Meshes``).
        content: identifier of the kept picture; empty at first.
    """

    def __init__(self, context: mujoco.MjrContext, height: int, width: int):
        opengl = calls()
        self._buffer, self._height, self._width = context.offFBO, height, width
        self._textures = [self._texture(of, context.offSamples) for of in (context.offColor, context.offDepthStencil)]
        self._kept = opengl.glGenFramebuffers(1)
        opengl.glBindFramebuffer(opengl.GL_FRAMEBUFFER, self._kept)
        places = opengl.GL_COLOR_ATTACHMENT0, opengl.GL_DEPTH_STENCIL_ATTACHMENT
        for place, texture in zip(places, self._textures, strict=True):
            opengl.glFramebufferTexture2D(opengl.GL_FRAMEBUFFER, place, opengl.GL_TEXTURE_2D_MULTISAMPLE, texture, 0)
        opengl.glBindFramebuffer(opengl.GL_FRAMEBUFFER, self._buffer)
        self._program = self._shaders()
        self._ties: int = np.atleast_1d(opengl.glGenQueries(1)).tolist()[0]
        self.number = calls().glGenLists(1)
        with recorded(self.number):
            self._write()
        self.content = b""

    def keep(self, content: bytes) -> None:
        """Copy the off-screen buffer.

        Args:
            content: identifier of the picture in the buffer.
        """
        # Disable the scissor test: OpenGL here copies each sample separately only if it copies the whole buffer.
        opengl, rectangle = calls(), (0, 0, self._width, self._height)
        opengl.glPushAttrib(opengl.GL_SCISSOR_BIT)
        opengl.glDisable(opengl.GL_SCISSOR_TEST)
        opengl.glBindFramebuffer(opengl.GL_READ_FRAMEBUFFER, self._buffer)
        opengl.glBindFramebuffer(opengl.GL_DRAW_FRAMEBUFFER, self._kept)
        opengl.glBlitFramebuffer(
            *rectangle, *rectangle, opengl.GL_COLOR_BUFFER_BIT | opengl.GL_DEPTH_BUFFER_BIT, opengl.GL_NEAREST
        )
        opengl.glBindFramebuffer(opengl.GL_FRAMEBUFFER, self._buffer)
        opengl.glPopAttrib()
        self.content = content

    def ties(self) -> int:
        """Return the number of samples at which the last picture over the underlay had another geom of equal depth."""
        return int(calls().glGetQueryObjectuiv(self._ties, calls().GL_QUERY_RESULT))

    def _write(self) -> None:
        """Write the kept colour and depth into the current buffer."""
        opengl = calls()
        opengl.glPushAttrib(opengl.GL_ALL_ATTRIB_BITS)
        for setting in ("ALPHA_TEST", "BLEND", "CULL_FACE", "POLYGON_OFFSET_FILL", "STENCIL_TEST"):
            opengl.glDisable(getattr(opengl, f"GL_{setting}"))
        opengl.glEnable(opengl.GL_DEPTH_TEST)
        opengl.glPolygonMode(opengl.GL_FRONT_AND_BACK, opengl.GL_FILL)
        opengl.glViewport(0, 0, self._width, self._height)
        for unit, texture in enumerate(self._textures):
            opengl.glActiveTexture(opengl.GL_TEXTURE0 + unit)
            opengl.glBindTexture(opengl.GL_TEXTURE_2D_MULTISAMPLE, texture)
        opengl.glUseProgram(self._program)
        # First count the samples of equal depth, and write nothing.
        opengl.glColorMask(False, False, False, False)
        opengl.glDepthMask(False)
        opengl.glDepthFunc(opengl.GL_EQUAL)
        opengl.glBeginQuery(opengl.GL_SAMPLES_PASSED, self._ties)
        opengl.glRectf(-1, -1, 1, 1)
        opengl.glEndQuery(opengl.GL_SAMPLES_PASSED)
        # MuJoCo's depth grows towards the camera.
        opengl.glDepthFunc(opengl.GL_GEQUAL)
        opengl.glDepthMask(True)
        opengl.glColorMask(True, True, True, True)
        opengl.glRectf(-1, -1, 1, 1)
        opengl.glUseProgram(0)
        opengl.glPopAttrib()

    def _texture(self, renderbuffer: int, samples: int) -> int:
        """Create a texture with a renderbuffer's number of samples and format, which an exact copy needs."""
        opengl = calls()
        opengl.glBindRenderbuffer(opengl.GL_RENDERBUFFER, renderbuffer)
        kind = opengl.glGetRenderbufferParameteriv(opengl.GL_RENDERBUFFER, opengl.GL_RENDERBUFFER_INTERNAL_FORMAT)
        texture: int = opengl.glGenTextures(1)
        opengl.glBindTexture(opengl.GL_TEXTURE_2D_MULTISAMPLE, texture)
        opengl.glTexImage2DMultisample(opengl.GL_TEXTURE_2D_MULTISAMPLE, samples, kind, self._width, self._height, True)
        opengl.glBindTexture(opengl.GL_TEXTURE_2D_MULTISAMPLE, 0)
        return texture

    def _shaders(self) -> int:
        """Compile and link the program that writes the underlay, and return its number.

        Raises:
            PipelineError: if OpenGL rejects the shaders.
        """
        opengl = calls()
        program: int = opengl.glCreateProgram()
        for kind, text in ((opengl.GL_VERTEX_SHADER, _VERTICES), (opengl.GL_FRAGMENT_SHADER, _SAMPLES)):
            shader = opengl.glCreateShader(kind)
            opengl.glShaderSource(shader, text)
            opengl.glCompileShader(shader)
            opengl.glAttachShader(program, shader)
            opengl.glDeleteShader(shader)
        opengl.glLinkProgram(program)
        if not opengl.glGetProgramiv(program, opengl.GL_LINK_STATUS):
            raise failure(f"OpenGL rejects the shaders of underlays: {opengl.glGetProgramInfoLog(program)!r}")
        opengl.glUseProgram(program)
        for unit, name in enumerate(("colours", "depths")):
            opengl.glUniform1i(opengl.glGetUniformLocation(program, name), unit)
        opengl.glUseProgram(0)
        return program
