"""Choice of the faces of a mesh that cover a sample of the picture; all other faces change no pixel.

A picture has four samples a pixel (multisampling), and most faces of LIBERO's meshes lie between samples. In an agent
view, the arm has 90,000 faces, of which 17,000 cover a sample and face the camera. MuJoCo passes all faces to OpenGL,
which tests each face.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.jit import compiled
from pipeline.rendering.software.faces import Faces
from pipeline.types import Floats

BATCH_FACES = 341
"""Number of faces of a display list or an index buffer that llvmpipe processes at once, as a batch.

llvmpipe tests which side of each face is seen. If a face of the batch has a corner outside of the view, this test comes
before the corners are rounded, else afterwards.
"""

MARGIN_PX = 1 / 128
"""Distance from a face within which a sample counts as covered.

OpenGL rounds corners to 1/256 of a pixel, so a corner moves by up to half of that.
"""

SAMPLES = 4
"""Number of samples of a pixel, which LIBERO's scenes request."""


class Projection(NamedTuple):
    """Projection of places in a frame of reference, first the world's, to a picture.

    Attributes:
        matrix: (3, 4) maps a place, in m, to its column, its row from below, and 1, all times its depth.
        near_m, far_m: depths before and beyond which nothing is rendered.
        size_px: width and height.
    """

    matrix: Floats
    near_m: float
    far_m: float
    size_px: tuple[int, int]

    def from_frame(self, position_m: Floats, rotation: Floats) -> Projection:
        """Return this projection for places in another frame, which has a position (3,) and a rotation (9,)."""
        matrix = np.empty((3, 4))
        matrix[:, :3] = self.matrix[:, :3] @ rotation.reshape(3, 3)
        matrix[:, 3] = self.matrix[:, :3] @ position_m + self.matrix[:, 3]
        return self._replace(matrix=matrix)


def room(faces: int) -> int:
    """Return the largest number of corners that ``faces_that_show`` writes for a mesh of ``faces`` faces.

    It writes all faces, as many faces again that fill batches, and in each batch a face that brings in a corner outside
    of the view.
    """
    return 3 * (2 * faces + 2 * (2 * faces // BATCH_FACES + 2) + BATCH_FACES)


def faces_that_show(
    projection: Projection, faces: Faces, samples: NDArray[np.float32], found: NDArray[np.uint32]
) -> int:
    """Write the corners of all faces that may cover a sample, in their order, with some faces without area between.

    Two loops without branches leave out faces in turn. With branches, wrong predictions by the processor would take
    most of the time.

    Args:
        projection: the picture's projection from the frame of the mesh.
        faces: the mesh's faces; their corners are counter-clockwise as seen from the front.
        samples: (``SAMPLES``, 2) place of each sample in its pixel, 0 to 1 to the right and up.
        found: (``room(F)``,) output array.

    Returns:
        The number of corners written.
    """
    matrix, near_m, far_m, size_px = projection
    corners = faces.place_of_corner
    at_px, outside = _projected(matrix, near_m, far_m, faces.places_m, *size_px)
    left, doubtful, before = _facing(at_px, outside, corners, BATCH_FACES)
    count, either_way = _covering(at_px, corners, samples, *size_px, left, doubtful, before)
    return _in_batches(
        faces.corners, corners, outside, left[:count], before[:count], either_way[:count], BATCH_FACES, found
    )


# Numba does not compile the pipeline's records, so the compiled loops take arrays and numbers as single arguments.


@compiled
def _projected(
    matrix: Floats, near_m: float, far_m: float, places_m: NDArray[np.float32], width_px: int, height_px: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Project places (P, 3) to the picture.

    Returns:
        (P, 2) columns and rows, NaN near the near plane and before it; and a mask (P,) of places outside of the view.
    """
    at_px, outside = np.empty((len(places_m), 2), np.float32), np.empty(len(places_m), np.bool_)
    for place in range(len(places_m)):
        x, y, z = places_m[place, 0], places_m[place, 1], places_m[place, 2]
        depth_m = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
        column = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / depth_m
        row = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / depth_m
        out = (column < 0) | (column > width_px) | (row < 0) | (row > height_px)
        outside[place] = out | (depth_m < near_m) | (depth_m > far_m)
        # The near plane cuts a face, which then has other corners. Comparisons with NaN keep the face.
        at_px[place, 0] = column if depth_m > 1.01 * near_m else np.nan
        at_px[place, 1] = row if depth_m > 1.01 * near_m else np.nan
    return at_px, outside


@compiled
def _facing(
    at_px: NDArray[np.float32], outside: NDArray[np.bool_], place_of_corner: NDArray[np.uint32], batch_faces: int
) -> tuple[NDArray[np.int32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Find the faces (L,) that may face the camera.

    Returns:
        Their numbers (L,); a mask (L,) of faces that may also be turned away; and a mask (L,) of faces whose batch
        OpenGL sorts by front and back before it rounds corners.
    """
    left_over, doubtful = np.empty(len(place_of_corner), np.int32), np.empty(len(place_of_corner), np.bool_)
    before = np.empty(len(place_of_corner), np.bool_)
    margin, count = np.float32(MARGIN_PX), 0
    for batch in range((len(place_of_corner) + batch_faces - 1) // batch_faces):
        first, last = batch_faces * batch, min(batch_faces * (batch + 1), len(place_of_corner))
        sorted_before = False
        for face in range(first, last):
            a, b, c = place_of_corner[face, 0], place_of_corner[face, 1], place_of_corner[face, 2]
            sorted_before |= outside[a] | outside[b] | outside[c]
        for face in range(first, last):
            a, b, c = place_of_corner[face, 0], place_of_corner[face, 1], place_of_corner[face, 2]
            cax, cay = at_px[a, 0] - at_px[c, 0], at_px[a, 1] - at_px[c, 1]
            cbx, cby = at_px[b, 0] - at_px[c, 0], at_px[b, 1] - at_px[c, 1]
            twice_area = cax * cby - cay * cbx
            # If the area is closer to 0 than this, the face may turn around when its corners are rounded.
            unsure = margin * (abs(cax) + abs(cay) + abs(cbx) + abs(cby) + margin)
            left_over[count], doubtful[count] = face, not twice_area > unsure
            before[count] = sorted_before
            count += not twice_area < (-unsure / 8 if sorted_before else -unsure)
    return left_over[:count], doubtful[:count], before[:count]


@compiled
def _covering(
    at_px: NDArray[np.float32],
    place_of_corner: NDArray[np.uint32],
    samples: NDArray[np.float32],
    width_px: int,
    height_px: int,
    left_over: NDArray[np.int32],
    doubtful: NDArray[np.bool_],
    before: NDArray[np.bool_],
) -> tuple[int, NDArray[np.bool_]]:
    """Keep the faces that may cover a sample of the picture.

    The last three arguments are the results of ``_facing``. The kept faces are written to the front of ``left_over``
    and ``before``.

    Returns:
        The number of kept faces; and a mask of the faces that may face either way.
    """
    either_way = np.empty(len(left_over), np.bool_)
    margin, count = np.float32(MARGIN_PX), 0
    for number in range(len(left_over)):
        face = left_over[number]
        a, b, c = place_of_corner[face, 0], place_of_corner[face, 1], place_of_corner[face, 2]
        ax, ay, bx, by, cx, cy = at_px[a, 0], at_px[a, 1], at_px[b, 0], at_px[b, 1], at_px[c, 0], at_px[c, 1]
        left, low = min(ax, bx, cx) - margin, min(ay, by, cy) - margin
        right, high = max(ax, bx, cx) + margin, max(ay, by, cy) + margin
        inside = (right >= 0) & (left <= width_px) & (high >= 0) & (low <= height_px)
        wide = (right - left > 1) | (high - low > 1)
        abx, aby, bcx, bcy, cax, cay = bx - ax, by - ay, cx - bx, cy - by, ax - cx, ay - cy
        # These are the constant terms of a place's distance to the left of each side, times the side's length.
        ab = margin * (abs(abx) + abs(aby)) - abx * ay + aby * ax
        bc = margin * (abs(bcx) + abs(bcy)) - bcx * by + bcy * bx
        ca = margin * (abs(cax) + abs(cay)) - cax * cy + cay * cx
        covers = False
        for sample in range(SAMPLES):
            x = np.ceil(left - samples[sample, 0]) + samples[sample, 0]
            y = np.ceil(low - samples[sample, 1]) + samples[sample, 1]
            within = (x <= right) & (y <= high) & (abx * y - aby * x + ab >= 0)
            covers |= within & (bcx * y - bcy * x + bc >= 0) & (cax * y - cay * x + ca >= 0)
        cut = ax + bx + cx
        unsure = margin * (abs(cax) + abs(cay) + abs(bcx) + abs(bcy) + margin)
        left_over[count], before[count] = face, before[number]
        # OpenGL computes in the same precision, so it may see the face either way.
        either_way[count] = cay * bcx - cax * bcy <= unsure / 8
        count += (inside & (covers | wide | doubtful[number])) | (cut != cut)
    return count, either_way


@compiled
def _in_batches(
    corners: NDArray[np.uint32],
    place_of_corner: NDArray[np.uint32],
    outside: NDArray[np.bool_],
    faces: NDArray[np.int32],
    before: NDArray[np.bool_],
    either_way: NDArray[np.bool_],
    batch_faces: int,
    found: NDArray[np.uint32],
) -> int:
    """Write faces so that OpenGL sorts faces that may face either way as it sorts them in the whole mesh.

    OpenGL divides the written faces into batches. Additional faces without area fill up a batch, or bring a corner
    outside of the view into it.

    Returns:
        The number of corners written.
    """
    written, met_outside, met_after = 0, False, False
    for number in range(len(faces)):
        face = faces[number]
        a, b, c = place_of_corner[face, 0], place_of_corner[face, 1], place_of_corner[face, 2]
        reaches_out = outside[a] | outside[b] | outside[c]
        after = either_way[number] and not before[number]
        outsider = either_way[number] and before[number] and not reaches_out
        clash = (met_outside and after) or (met_after and (reaches_out or outsider))
        # A face with an added corner outside of the view takes a second place in its batch.
        places_left = (batch_faces - written % batch_faces) % batch_faces
        fill = places_left if clash or (outsider and places_left == 1) else 0
        for _ in range(fill):
            found[3 * written : 3 * written + 3] = found[3 * written - 1]
            written += 1
        if written % batch_faces == 0:
            met_outside, met_after = False, False
        for corner in range(3):
            found[3 * written + corner] = corners[face, corner]
        written += 1
        if outsider and not met_outside:
            corner = 3 * batch_faces * (face // batch_faces)
            while not outside[place_of_corner[corner // 3, corner % 3]]:
                corner += 1
            found[3 * written : 3 * written + 3] = corners[corner // 3, corner % 3]
            written += 1
        met_outside, met_after = met_outside or reaches_out or outsider, met_after or after
    return 3 * written
