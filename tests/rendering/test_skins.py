"""Of a mesh only faces that can show are rendered, and every picture is the one that MuJoCo renders of all faces."""

import ctypes
from contextlib import closing

import mujoco
import numpy as np
import pytest
import trimesh
from arenas import both_ways
from numpy.typing import NDArray

from pipeline import gl, seeding
from pipeline.rendering import opengl
from pipeline.rendering.opengl import calls
from pipeline.rendering.renderer import Renderer
from pipeline.rendering.software.faces import Faces
from pipeline.rendering.software.mujoco_3_2_7.context import SKINS
from pipeline.rendering.software.mujoco_3_2_7.skins import GEOM
from pipeline.rendering.software.samples import BATCH_FACES, Projection, faces_that_show, room
from pipeline.types import Floats, Frame

SIZE_PX = 64, 48
VIEW_PX = 32, 24
"""Width and height of a view in which every face is tried at every sample."""

SAMPLES = np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]], np.float32)


def covers(corners_px: Floats, sample_px: Floats) -> NDArray[np.bool_]:
    """(F,) whether a sample is in faces (F, 3, 2), or on their edge; front faces only."""
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    to_sample = sample_px - corners_px
    left = sides[..., 0] * to_sample[..., 1] - sides[..., 1] * to_sample[..., 0]
    return np.asarray((left >= 0).all(axis=1) & (left > 0).any(axis=1))


@pytest.mark.parametrize("size_px", [0.05, 0.3, 0.9, 3.0, 30.0])
def test_no_face_is_left_out_that_covers_a_sample(size_px: float) -> None:
    rng = seeding.rng("test_skins", str(size_px))
    count = 9 * BATCH_FACES - 100
    # Before the camera at a depth of 1 m, where a pixel is a hundredth of a metre wide.
    focal_px = 100.0
    middles_px = rng.uniform(-3, np.array(VIEW_PX) + 3, (count, 1, 2))
    corners_px = middles_px + rng.normal(0, size_px, (count, 3, 2))
    # Some have hardly any area, and may turn to the front when their corners are rounded.
    corners_px[::10, 2] = corners_px[::10].mean(axis=1) + rng.normal(0, 1e-3, (len(corners_px[::10]), 2))
    places_m = np.ones((3 * count, 3), np.float32)
    places_m[:, :2] = corners_px.reshape(-1, 2) / focal_px
    numbers = np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)
    faces = Faces(places_m, places_m, None, numbers, places_m, numbers)
    projection = Projection(np.diag([focal_px, focal_px, 1.0]) @ np.eye(3, 4), 0.1, 10.0, VIEW_PX)
    found = np.empty(room(count), np.uint32)
    written = faces_that_show(projection, faces, SAMPLES, found)
    listed = found[:written].reshape(-1, 3)
    shown = listed[listed[:, 0] != listed[:, 1]]
    assert np.array_equal(shown, numbers[np.sort(shown[:, 0] // 3)]), "whole faces, in their order"

    rounded = np.rint(corners_px * 256) / 256
    needed = np.zeros(count, np.bool_)
    for column, row in np.ndindex(VIEW_PX):
        for sample in SAMPLES.astype(float):
            needed |= covers(rounded, np.array([column, row]) + sample)
    # The next test is about what turns around.
    needed &= twice_area(corners_px) > 0
    left_out = np.ones(count, np.bool_)
    left_out[shown[:, 0] // 3] = False
    assert not (needed & left_out).any()
    assert 0.4 < left_out.mean() < 1, "those that face away, and those between samples"


def test_a_face_that_reaches_the_camera_stays() -> None:
    places_m = np.array([[0, 0, 1], [0.001, 0, 1], [0, 0.001, -1]], np.float32)
    numbers = np.array([[0, 1, 2]], np.uint32)
    faces, found = Faces(places_m, places_m, None, numbers, places_m, numbers), np.empty(room(1), np.uint32)
    projection = Projection(np.eye(3, 4), 0.1, 10.0, SIZE_PX)
    assert faces_that_show(projection, faces, SAMPLES, found) == 3


def test_a_geom_lies_in_memory_as_mujoco_has_it() -> None:
    scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), 2)
    first, second = scene.geoms
    addresses = {name: getattr(first, name).ctypes.data for name in ("size", "pos", "mat", "rgba")}
    offsets = {name: GEOM.fields[name][1] for name in addresses}  # type: ignore[index]
    begin = addresses["size"] - offsets["size"]
    assert {name: address - begin for name, address in addresses.items()} == offsets
    assert second.size.ctypes.data - first.size.ctypes.data == GEOM.itemsize
    geoms = np.frombuffer(memoryview((ctypes.c_byte * GEOM.itemsize).from_address(begin)), GEOM)
    for name in ("type", "dataid", "objtype", "objid", "category", "matid", "texcoord", "segid", "transparent"):
        setattr(first, name, 1)
        assert geoms[name][0] == getattr(first, name) == 1
        setattr(first, name, 0)
        assert geoms[name][0] == 0
    first.emission, first.reflectance, first.camdist, first.modelrbound = 0.125, 0.25, 0.5, 0.75
    assert geoms[["emission", "reflectance", "camdist", "modelrbound"]][0].tolist() == (0.125, 0.25, 0.5, 0.75)


SLIVERS = 1_000_000


def turning_faces() -> Floats:
    """(N, 3, 2) thin faces that face away, or about so, until their corners are rounded, and then cover a sample."""
    rng = seeding.rng("test_skins", "slivers")
    middle = 20.5 + rng.uniform(-5, 5, (SLIVERS, 1, 2))
    along = np.stack([rng.uniform(low, high, SLIVERS) for low, high in ((-1, -0.3), (-0.3, 0.3), (0.3, 1))], axis=1)
    corners_px = middle + along[..., None] * rng.normal(size=(SLIVERS, 1, 2)) + rng.normal(0, 0.002, (SLIVERS, 3, 2))
    corners_px[::2, 1] = corners_px[::2, ::2].mean(axis=1) + rng.normal(0, 1e-5, (SLIVERS // 2, 2))
    rounded = np.rint(corners_px * 256) / 256
    # Of some it is a matter of single precision which way they face.
    turned = (twice_area(corners_px) < 1e-5) & (twice_area(rounded) > 0)
    corners_px, rounded = corners_px[turned], rounded[turned]
    covering = np.zeros(len(rounded), np.bool_)
    for column, row in np.ndindex(4, 4):
        for sample in SAMPLES.astype(float):
            # The samples of the pixels from where the face begins on.
            places_px = np.floor(rounded.min(axis=1)) + (np.array([column, row]) + sample)
            covering |= covers(rounded, places_px[:, None])
    return corners_px[covering]


def twice_area(corners_px: Floats) -> Floats:
    """(N,) of faces (N, 3, 2); negative for those that face away."""
    (abx, aby), (acx, acy) = (np.moveaxis(corners_px[:, n] - corners_px[:, 0], -1, 0) for n in (1, 2))
    areas: Floats = abx * acy - aby * acx
    return areas


class FaceRenderer:
    """Faces rendered by OpenGL alone into MuJoCo's buffer, from a display list or by the order of a buffer."""

    def __init__(self) -> None:
        gl.prepare()
        model = mujoco.MjModel.from_xml_string(
            '<mujoco><visual><global offwidth="64" offheight="48"/></visual></mujoco>'
        )
        self._renderer = mujoco.Renderer(model, SIZE_PX[1], SIZE_PX[0])
        self._renderer._gl_context.make_current()

    def picture(self, places: NDArray[np.float32], listed: NDArray[np.uint32], by_list: bool) -> Frame:
        """Of white faces that face the camera.

        Args:
            places: (V, 4) in OpenGL's clip coordinates.
            listed: numbers of the corners.
            by_list: whether from a display list, as MuJoCo renders meshes, or from buffers, as it renders skins.
        """
        opengl, context = calls(), self._renderer._mjr_context
        opengl.glViewport(0, 0, *SIZE_PX)
        opengl.glClipControl(opengl.GL_LOWER_LEFT, opengl.GL_ZERO_TO_ONE)
        for setting in (opengl.GL_LIGHTING, opengl.GL_DEPTH_TEST):
            opengl.glDisable(setting)
        opengl.glEnable(opengl.GL_CULL_FACE)
        for matrices in (opengl.GL_PROJECTION, opengl.GL_MODELVIEW):
            opengl.glMatrixMode(matrices)
            opengl.glLoadIdentity()
        opengl.glClear(opengl.GL_COLOR_BUFFER_BIT | opengl.GL_DEPTH_BUFFER_BIT)
        opengl.glColor3f(1, 1, 1)
        if by_list:
            number = opengl.glGenLists(1)
            opengl.glNewList(number, opengl.GL_COMPILE)
            opengl.glBegin(opengl.GL_TRIANGLES)
            for corner in places[listed].tolist():
                opengl.glVertex4f(*corner)
            opengl.glEnd()
            opengl.glEndList()
            opengl.glCallList(number)
            opengl.glDeleteLists(number, 1)
        else:
            buffers = opengl.glGenBuffers(2)
            opengl.glBindBuffer(opengl.GL_ARRAY_BUFFER, buffers[0])
            opengl.glBufferData(opengl.GL_ARRAY_BUFFER, places.nbytes, places, opengl.GL_STATIC_DRAW)
            opengl.glEnableClientState(opengl.GL_VERTEX_ARRAY)
            opengl.glVertexPointer(4, opengl.GL_FLOAT, 0, None)
            opengl.glBindBuffer(opengl.GL_ELEMENT_ARRAY_BUFFER, buffers[1])
            opengl.glBufferData(opengl.GL_ELEMENT_ARRAY_BUFFER, listed.nbytes, listed, opengl.GL_STREAM_DRAW)
            opengl.glDrawElements(opengl.GL_TRIANGLES, len(listed), opengl.GL_UNSIGNED_INT, None)
            opengl.glDisableClientState(opengl.GL_VERTEX_ARRAY)
            for kind in (opengl.GL_ARRAY_BUFFER, opengl.GL_ELEMENT_ARRAY_BUFFER):
                opengl.glBindBuffer(kind, 0)
            opengl.glDeleteBuffers(2, buffers)
        frame: Frame = np.empty((SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
        mujoco.mjr_readPixels(frame, None, mujoco.MjrRect(0, 0, *SIZE_PX), context)
        return frame

    def close(self) -> None:
        self._renderer.close()


@pytest.mark.slow
def test_faces_that_turn_around_are_rendered_where_opengl_does_so_of_the_whole_mesh() -> None:
    """In a batch with a corner outside of the view, OpenGL sorts out what faces away before it rounds corners."""
    rng, turning = seeding.rng("test_skins", "batches"), turning_faces()
    assert len(turning) > 50
    projection = Projection(np.eye(3, 4), 0.1, 10.0, SIZE_PX)
    count, shown = 6 * BATCH_FACES - 50, []
    with closing(FaceRenderer()) as renderer:
        for outside in (0.0, 0.001, 0.002, 0.01):
            # Far from those that may turn, some face away, some are seen.
            corners_px = rng.uniform((30, 2), (60, 46), (count, 1, 2)) + rng.normal(0, 0.4, (count, 3, 2))
            places = rng.random(count) < 0.02
            corners_px[places] = rng.choice(turning, places.sum())
            corners_px[rng.random(count) < outside] += [40, 0]
            places_m = np.ones((3 * count, 3), np.float32)
            places_m[:, :2] = corners_px.reshape(-1, 2)
            numbers = np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)
            faces, found = Faces(places_m, places_m, None, numbers, places_m, numbers), np.empty(room(count), np.uint32)
            written = faces_that_show(projection, faces, SAMPLES, found)
            assert written < 0.8 * 3 * count
            clip = np.column_stack([2 * places_m[:, :2] / SIZE_PX - 1, np.full((3 * count, 2), (0.5, 1.0))])
            clip = clip.astype(np.float32)
            plain = renderer.picture(clip, numbers.ravel(), by_list=True)
            assert np.array_equal(renderer.picture(clip, found[:written], by_list=False), plain)
            shown.append(int((plain[:, :30] > 0).sum()))
    assert shown[0] > shown[-1], "where corners are outside, fewer of those that turn are rendered"


def stone(name: str, subdivisions: int, texture: bool) -> str:
    """A round mesh of many faces."""
    shape = trimesh.creation.icosphere(subdivisions)
    written = {"vertex": shape.vertices * 0.3, "face": shape.faces}
    if texture:
        written["texcoord"] = shape.vertices[:, :2]
    attributes = " ".join(f'{key}="{" ".join(map(str, values.ravel()))}"' for key, values in written.items())
    return f'<mesh name="{name}" {attributes}/>'


def scene(shadows: bool) -> str:
    """Stones around a mirror, with and without places in a texture, some far away, and two of one mesh, one clear."""
    rng = seeding.rng("test_skins", "scene")
    stones = [("plain", 'rgba="0.4 0.6 0.2 1"'), ("painted", 'material="paint"'), ("both", 'rgba="0.7 0.3 0.3 1"')]
    bodies = "".join(
        f'<body mocap="true" pos="{" ".join(f"{x:.3f}" for x in rng.uniform((-0.5, -0.5, 0.1), (0.5, 0.5, 0.8)))}">'
        f'<geom type="mesh" mesh="{mesh}" {look} group="1"/></body>'
        for mesh, look in [*stones, ("both", 'rgba="0.2 0.3 0.9 0.4"'), ("plain", 'rgba="0.9 0.6 0.2 1"')]
    )
    return f"""
    <mujoco>
      <asset>
        {stone("plain", 3, False)}{stone("painted", 4, True)}{stone("both", 3, False)}
        <texture name="chequers" type="2d" builtin="checker" rgb1="0.9 0.8 0.2" rgb2="0 0 0.4" width="64" height="64"/>
        <material name="paint" texture="chequers" specular="0.7"/><material name="mirror" reflectance="0.4"/>
      </asset>
      <worldbody>
        <light pos="0.5 0 3" dir="0 0 -1" castshadow="false"/>
        <light pos="-1 1 3" dir="0.3 -0.3 -1" diffuse="0.3 0.3 0.4" castshadow="{str(shadows).lower()}"/>
        <geom type="box" size="0.9 0.9 0.01" group="1" material="mirror"/>
        <geom type="plane" size="3 3 0.1" pos="0 0 -0.5" group="1" rgba="0.5 0.5 0.5 1"/>
        {bodies}
        <camera name="fixed" pos="3 0 1.5" xyaxes="0 1 0 -0.4 0 1"/>
        <body mocap="true" pos="0 1.5 0.7"><camera name="moving" xyaxes="-1 0 0 0 -0.4 1"/></body>
      </worldbody>
    </mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [False, True], ids=["lights", "shadows"])
def test_the_same_pixels_with_fewer_faces(shadows: bool) -> None:
    rng, rendered = seeding.rng("test_skins", "moves"), []
    opened = Renderer(scene(shadows))
    with both_ways(opened) as (ours, plain):
        for _ in range(15):
            for body in rng.choice(5, 2, replace=False):
                opened.data.mocap_pos[body] += rng.normal(0, 0.1, 3)
                opened.data.mocap_quat[body] = rng.normal(size=4)
            opened.data.mocap_pos[-1] += rng.normal(0, 0.05, 3)
            mujoco.mj_forward(opened.model, opened.data)
            for camera in ("fixed", "moving"):
                ours._skins.rendered[:] = 0
                frame = opened.frame(camera)
                rendered.append(ours._skins.rendered.copy())
                assert np.array_equal(frame, plain.frame(opened.data, camera)), camera
        whole = opened.model.mesh("painted").facenum[0]
    faces = np.sum(rendered, axis=0)
    assert faces[:SKINS].any(), "with places in a texture"
    assert faces[SKINS:].any(), "without them"
    assert np.max(rendered) < 0.6 * whole, "half of the faces are on the other side"


@pytest.mark.slow
def test_display_lists_may_be_numbered_downwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mesa 22 counts on, Mesa 25 fills gaps, so that a later block may have lower numbers."""
    gl.prepare()
    functions, lowest = opengl._FUNCTIONS, 0
    upwards = functions.glGenLists

    def downwards(count: int) -> int:
        nonlocal lowest
        lowest = (lowest or upwards(1000) + 1000) - count
        return lowest

    monkeypatch.setattr(functions, "glGenLists", downwards)
    opened = Renderer(scene(shadows=False))
    with both_ways(opened) as (ours, plain):
        mujoco.mj_forward(opened.model, opened.data)
        # Each picture would leave matrices on a stack of 32.
        for _ in range(12):
            for camera in ("fixed", "moving"):
                assert np.array_equal(opened.frame(camera), plain.frame(opened.data, camera)), camera
        assert ours._skins.rendered.any()
    assert lowest
