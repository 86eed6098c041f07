"""Where added objects stand: the regions of each arena in which LIBERO-Plus puts them.

LIBERO-Plus puts objects on 5 to 8 points of each arena: some between the camera and the things that the task is about,
the others beside and behind these. The regions here are the bounds of either group, widened by about 8 cm. A place is
drawn anywhere in them; how often in front is how often the benchmark's 829 test tasks put an object there.
"""

from typing import NamedTuple

import numpy as np

from pipeline.libero.bddl import Arena
from pipeline.types import Floats


class Region(NamedTuple):
    """A rectangle of the working surface.

    Attributes:
        x_m, y_m: bounds in the world; x points from the robot to the camera.
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]

    def draw(self, rng: np.random.Generator) -> Floats:
        """(2,) a place in it."""
        return np.array([rng.uniform(*self.x_m), rng.uniform(*self.y_m)])


class Regions(NamedTuple):
    """The regions of an arena.

    Attributes:
        front: on the camera's side.
        back: beside and behind what the task is about.
        front_share: how often an object is put in front.
    """

    front: Region
    back: Region
    front_share: float

    def order(self, rng: np.random.Generator) -> tuple[Region, Region]:
        """The region for an object, and the one to try where it does not fit there."""
        return (self.front, self.back) if rng.random() < self.front_share else (self.back, self.front)


REGIONS: dict[Arena, Regions] = {
    "tabletop": Regions(Region((0.19, 0.32), (-0.24, 0.28)), Region((-0.48, 0.13), (0.12, 0.48)), 0.60),
    "floor": Regions(Region((0.22, 0.38), (-0.28, 0.28)), Region((-0.38, -0.22), (-0.33, 0.33)), 0.60),
    "kitchen": Regions(Region((0.17, 0.28), (-0.23, 0.23)), Region((-0.38, -0.17), (-0.33, 0.28)), 0.60),
    # From 0.19 m on, where the benchmark has objects at 0.1 and 0.2 m: 38 % of the test's stand on the camera's side.
    "living_room": Regions(Region((0.19, 0.27), (-0.28, 0.23)), Region((-0.48, -0.17), (-0.38, 0.33)), 0.40),
    # The study's table stands at x = -0.2.
    "study": Regions(Region((-0.07, 0.08), (-0.33, 0.28)), Region((-0.48, -0.12), (-0.28, 0.38)), 0.38),
}
"""The regions of each of LIBERO's arenas."""
