"""A part of a picture that is drawn once and then laid into many pictures, sample by sample."""

from __future__ import annotations

import mujoco

VERTICES = "#version 400 compatibility\nvoid main() { gl_Position = gl_Vertex; }"

# The far end of MuJoCo's depth is 0: nothing was drawn there, and what was is the sky, which is in every picture.
SAMPLES = """#version 400 compatibility
uniform sampler2DMS colours, depths;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float depth = texelFetch(depths, pixel, gl_SampleID).r;
    if (depth == 0.0) discard;
    gl_FragColor = texelFetch(colours, pixel, gl_SampleID);
    gl_FragDepth = depth;
}
"""


class Layer:
    """Colour and depth of every sample of a picture; MuJoCo's OpenGL context must be the current one.

    Attributes:
        content: tells what was kept from anything else; empty at first.

    Args:
        context: of MuJoCo, in whose off-screen buffer the pictures are drawn.
        height, width: of the pictures, which begin in that buffer's corner.
    """

    @staticmethod
    def possible() -> bool:
        """Whether the current OpenGL has shaders that run once for each sample."""
        from OpenGL import GL

        GL.glGetError()
        return bool(GL.glGetIntegerv(GL.GL_MAJOR_VERSION) >= 4)

    def __init__(self, context: mujoco.MjrContext, height: int, width: int):
        from OpenGL import GL

        self._gl, self._buffer, self._height, self._width = GL, context.offFBO, height, width
        self._forget_errors()
        self._textures = [
            self._texture(context.offColor, context.offSamples),
            self._texture(context.offDepthStencil, context.offSamples),
        ]
        self._kept = GL.glGenFramebuffers(1)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._kept)
        for place, texture in zip(
            (GL.GL_COLOR_ATTACHMENT0, GL.GL_DEPTH_STENCIL_ATTACHMENT), self._textures, strict=True
        ):
            GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, place, GL.GL_TEXTURE_2D_MULTISAMPLE, texture, 0)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._buffer)
        self._program = self._shaders()
        self.content = b""

    def keep(self, content: bytes) -> None:
        """Copy what is drawn in the off-screen buffer."""
        gl, rectangle = self._gl, (0, 0, self._width, self._height)
        self._forget_errors()
        gl.glPushAttrib(gl.GL_SCISSOR_BIT)
        gl.glDisable(gl.GL_SCISSOR_TEST)
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._buffer)
        gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, self._kept)
        gl.glBlitFramebuffer(*rectangle, *rectangle, gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT, gl.GL_NEAREST)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._buffer)
        gl.glPopAttrib()
        self.content = content

    def put(self, rows: slice, columns: slice) -> None:
        """Draw what was kept into a rectangle of the off-screen buffer, where nothing nearer is drawn.

        What is at the same depth is drawn over: a mirror by the same mirror with its images.

        Args:
            rows, columns: of the picture, the first row at the top.
        """
        gl = self._gl
        self._forget_errors()
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._buffer)
        gl.glPushAttrib(gl.GL_ALL_ATTRIB_BITS)
        for setting in (gl.GL_ALPHA_TEST, gl.GL_BLEND, gl.GL_CULL_FACE, gl.GL_POLYGON_OFFSET_FILL, gl.GL_STENCIL_TEST):
            gl.glDisable(setting)
        gl.glEnable(gl.GL_DEPTH_TEST)
        # MuJoCo's depth grows towards the camera.
        gl.glDepthFunc(gl.GL_GEQUAL)
        gl.glDepthMask(True)
        gl.glColorMask(True, True, True, True)
        gl.glPolygonMode(gl.GL_FRONT_AND_BACK, gl.GL_FILL)
        gl.glViewport(0, 0, self._width, self._height)
        gl.glEnable(gl.GL_SCISSOR_TEST)
        gl.glScissor(columns.start, self._height - rows.stop, columns.stop - columns.start, rows.stop - rows.start)
        for unit, texture in enumerate(self._textures):
            gl.glActiveTexture(gl.GL_TEXTURE0 + unit)
            gl.glBindTexture(gl.GL_TEXTURE_2D_MULTISAMPLE, texture)
        gl.glUseProgram(self._program)
        gl.glRectf(-1, -1, 1, 1)
        gl.glUseProgram(0)
        gl.glPopAttrib()

    def _texture(self, renderbuffer: int, samples: int) -> int:
        """A texture for as many samples as a renderbuffer has, in its format: others cannot be copied as they are."""
        gl = self._gl
        gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, renderbuffer)
        kind = gl.glGetRenderbufferParameteriv(gl.GL_RENDERBUFFER, gl.GL_RENDERBUFFER_INTERNAL_FORMAT)
        texture: int = gl.glGenTextures(1)
        gl.glBindTexture(gl.GL_TEXTURE_2D_MULTISAMPLE, texture)
        gl.glTexImage2DMultisample(gl.GL_TEXTURE_2D_MULTISAMPLE, samples, kind, self._width, self._height, True)
        gl.glBindTexture(gl.GL_TEXTURE_2D_MULTISAMPLE, 0)
        return texture

    def _shaders(self) -> int:
        from OpenGL.GL import shaders

        gl = self._gl
        program: int = shaders.compileProgram(
            shaders.compileShader(VERTICES, gl.GL_VERTEX_SHADER),
            shaders.compileShader(SAMPLES, gl.GL_FRAGMENT_SHADER),
            validate=False,
        )
        gl.glUseProgram(program)
        for unit, name in enumerate(("colours", "depths")):
            gl.glUniform1i(gl.glGetUniformLocation(program, name), unit)
        gl.glUseProgram(0)
        return program

    def _forget_errors(self) -> None:
        """Else PyOpenGL would raise here what MuJoCo's own calls have left."""
        self._gl.glGetError()
