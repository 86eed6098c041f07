"""Points that a picture and our frame have in common, which show if the camera stands elsewhere."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.evaluation.first_observation.picture_fit import SIZE_PX
from pipeline.images.jpeg import resized
from pipeline.types import Frame

RATIO = 0.75
"""Largest distance of a point's descriptor from the best match, in multiples of the next match's (Lowe's test)."""

TOLERANCE_PX = 2.0
"""Largest distance of a point from its place under the common transformation."""

FEWEST_POINTS = 12
"""Smallest number of matched points that show where a camera is."""

MANY_POINTS, MOST_POINTS = 30, 0.7
"""Smallest number, and smallest share, of points that move together if the camera moved."""

STILL_PX = 1.5
"""Largest shift of points of an unmoved camera."""


class Transformation(NamedTuple):
    """Transformation of our frame into a picture, by rotation, scale and shift; all pixels are pixels of 256.

    Attributes:
        points: number of points that agree with it.
        share: their share of all common points.
        shift_px: median distance of these points from their places in our frame.
    """

    points: int
    share: float
    shift_px: float
    scale: float
    rotation_deg: float

    @property
    def still(self) -> bool:
        """Return whether the points are where they are in our frame."""
        return self.shift_px <= STILL_PX

    @property
    def moved(self) -> bool:
        """Return whether nearly all points moved together, which things in another state do not."""
        return not self.still and self.points >= MANY_POINTS and self.share >= MOST_POINTS


def find_transformation(picture: Frame, frame: Frame) -> Transformation | None:
    """Find the transformation of the largest group of common points; `None` if the group is too small.

    The first group that is searched has points at equal places, so moved things do not count as a moved camera.
    """
    ours, theirs = _match_points(frame, picture)
    if len(ours) < FEWEST_POINTS:
        return None
    still = np.linalg.norm(theirs - ours, axis=1) <= STILL_PX
    if still.sum() >= max(FEWEST_POINTS, len(ours) / 2):
        shift_px = float(np.median(np.linalg.norm(theirs - ours, axis=1)[still]))
        return Transformation(int(still.sum()), float(still.mean()), shift_px, 1.0, 0.0)
    cv2.setRNGSeed(0)
    matrix, agree = cv2.estimateAffinePartial2D(ours, theirs, ransacReprojThreshold=TOLERANCE_PX)
    if matrix is None or agree.sum() < FEWEST_POINTS:
        return None
    inside = agree.ravel() > 0
    shift_px = float(np.median(np.linalg.norm(theirs - ours, axis=1)[inside]))
    scale = float(np.hypot(matrix[0, 0], matrix[1, 0]))
    rotation_deg = float(np.rad2deg(np.arctan2(matrix[1, 0], matrix[0, 0])))
    return Transformation(int(inside.sum()), float(inside.mean()), shift_px, scale, rotation_deg)


def _match_points(frame: Frame, picture: Frame) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the places (N, 2) of common points in our frame and in a picture, by SIFT's descriptors."""
    our_places, ours = _detect_points(frame)
    their_places, theirs = _detect_points(picture)
    pairs: list[tuple[int, int]] = []
    if len(ours) > 1 and len(theirs) > 1:
        for best, second in cv2.BFMatcher().knnMatch(ours, theirs, k=2):
            if best.distance < RATIO * second.distance:
                pairs.append((best.queryIdx, best.trainIdx))
    indices = np.array(pairs, np.intp).reshape(-1, 2)
    return our_places[indices[:, 0]], their_places[indices[:, 1]]


def _detect_points(image: Frame) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the places (N, 2) of an image's points and their descriptors (N, 128)."""
    grey = cv2.cvtColor(resized(image, SIZE_PX, SIZE_PX), cv2.COLOR_RGB2GRAY)
    everywhere = np.full(grey.shape, 255, np.uint8)
    points, descriptors = cv2.SIFT.create().detectAndCompute(grey, everywhere)
    places = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    # OpenCV returns None if there are no points.
    described = np.empty((0, 128)) if len(points) == 0 else descriptors
    return places, np.asarray(described, np.float32)
