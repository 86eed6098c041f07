"""LIBERO's five arenas: one record of each, with every fact that differs between them."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from pipeline.types import Floats

Arena = Literal["tabletop", "kitchen", "living_room", "study", "floor"]
"""LIBERO's rooms, which differ in table or floor, walls, lamps and the place of the agent view."""

TURN_WXYZ = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
LOW_TURN_WXYZ = (0.6182166934013367, 0.3432307541370392, 0.3432314395904541, 0.6182177066802979)
"""Orientations of LIBERO's agent views."""


class Region(NamedTuple):
    """A rectangle of the working surface.

    Attributes:
        x_m, y_m: bounds in the world; x points from the robot to the camera.
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]

    def sample(self, rng: np.random.Generator) -> Floats:
        """Sample a place (2,) in the region."""
        return np.array([rng.uniform(*self.x_m), rng.uniform(*self.y_m)])


class Regions(NamedTuple):
    """The regions of an arena in which objects are added.

    LIBERO-Plus puts objects on 5 to 8 points of each arena: some between the camera and the things that the task is
    about, the others next to and behind these things. The regions are the bounds of either group, widened by about
    8 cm. Places are sampled uniformly in them. The share of the front region is its share in the benchmark's 829 test
    tasks.

    Attributes:
        front: region on the camera's side.
        back: region next to and behind the things that the task is about.
        front_share: probability that an object is put in front.
    """

    front: Region
    back: Region
    front_share: float

    def order(self, rng: np.random.Generator) -> tuple[Region, Region]:
        """Sample the order of the regions for an object, which is tried in the second if the first has no place."""
        return (self.front, self.back) if rng.random() < self.front_share else (self.back, self.front)


@dataclass(frozen=True)
class Room:
    """Facts of an arena.

    Attributes:
        camera_m: position of LIBERO's agent view in the world (``_setup_camera`` of LIBERO's problems).
        camera_quat_wxyz: orientation of the agent view.
        camera_xz_m: position of the agent view along x in the frame of the working surface, and above it.
        surface_body: body of the working surface in the scene's model.
        robot_x_m: position of the robot's base along x, in the frame of the working surface.
        regions: regions in which objects are added.
        frame_s: times to render a frame of the agent view and of the wrist view, with savings: CPU time of one core of
            the machine that ``REFERENCE`` of ``run/work_time.py`` describes. The times are 0.8 of the results of
            ``benchmarks/frame_cost.py`` on a busy machine. They sum up to the stage of ``configs/starter.yaml``.
        surface_x_m: origin of the frame of the working surface along the world's x.
    """

    camera_m: tuple[float, float, float]
    camera_quat_wxyz: tuple[float, float, float, float]
    camera_xz_m: tuple[float, float]
    surface_body: str
    robot_x_m: float
    regions: Regions
    frame_s: tuple[float, float]
    surface_x_m: float = 0.0


ARENAS: dict[Arena, Room] = {
    "tabletop": Room(
        camera_m=(0.6586131746834771, 0.0, 1.6103500240372423),
        camera_quat_wxyz=TURN_WXYZ,
        camera_xz_m=(0.66, 0.71),
        surface_body="table",
        robot_x_m=-0.66,
        regions=Regions(Region((0.19, 0.32), (-0.24, 0.28)), Region((-0.48, 0.13), (0.12, 0.48)), 0.60),
        frame_s=(0.032, 0.041),
    ),
    "kitchen": Room(
        camera_m=(0.6586131746834771, 0.0, 1.6103500240372423),
        camera_quat_wxyz=TURN_WXYZ,
        camera_xz_m=(0.66, 0.71),
        surface_body="table",
        robot_x_m=-0.66,
        regions=Regions(Region((0.17, 0.28), (-0.23, 0.23)), Region((-0.38, -0.17), (-0.33, 0.28)), 0.60),
        frame_s=(0.041, 0.033),
    ),
    "living_room": Room(
        camera_m=(0.6065773716836134, 0.0, 0.96),
        camera_quat_wxyz=LOW_TURN_WXYZ,
        camera_xz_m=(0.61, 0.55),
        surface_body="living_room_table",
        robot_x_m=-0.51,
        # The front begins at 0.19 m, although the benchmark has objects at 0.1 and 0.2 m. 38 % of the benchmark's
        # objects stand on the camera's side.
        regions=Regions(Region((0.19, 0.27), (-0.28, 0.23)), Region((-0.48, -0.17), (-0.38, 0.33)), 0.40),
        frame_s=(0.024, 0.047),
    ),
    "study": Room(
        camera_m=(0.4586131746834771, 0.0, 1.6103500240372423),
        camera_quat_wxyz=TURN_WXYZ,
        camera_xz_m=(0.66, 0.74),
        surface_body="study_table",
        robot_x_m=-0.55,
        regions=Regions(Region((-0.07, 0.08), (-0.33, 0.28)), Region((-0.48, -0.12), (-0.28, 0.38)), 0.38),
        frame_s=(0.028, 0.035),
        surface_x_m=-0.2,
    ),
    "floor": Room(
        camera_m=(0.8965773716836134, 0.0, 0.65),
        camera_quat_wxyz=LOW_TURN_WXYZ,
        camera_xz_m=(0.90, 0.65),
        surface_body="floor",
        robot_x_m=-0.6,
        regions=Regions(Region((0.22, 0.38), (-0.28, 0.28)), Region((-0.38, -0.22), (-0.33, 0.33)), 0.60),
        frame_s=(0.022, 0.034),
    ),
}
"""Facts of each arena; a new arena is one more record. The floor comes last, because all arenas have a floor."""

SURFACES = tuple(dict.fromkeys(room.surface_body for room in ARENAS.values()))
"""Bodies of LIBERO's arenas that objects stand on; the first body that an arena has is its working surface."""
