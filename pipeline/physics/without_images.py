"""LIBERO's environments without images.

LIBERO compiles its scene with every reset, and MuJoCo keeps up to 500 MB of images that it has read.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from pipeline.scenes.flat_images import flat_images


@contextmanager
def images_left_out() -> Iterator[None]:
    """Let LIBERO's environments that are created in this context compile all their scenes without images.

    Such an environment has an attribute ``image_files``, the result of ``flat_images`` for its last compiled scene.
    LIBERO's table of classes changes meanwhile, so only one thread may create environments.
    """
    from libero.libero.envs import TASK_MAPPING

    usual = dict(TASK_MAPPING)
    TASK_MAPPING.update({name: _without_images(problem) for name, problem in usual.items()})
    try:
        yield
    finally:
        TASK_MAPPING.update(usual)


@cache
def _without_images(problem: Any) -> Any:
    """Return a subclass of LIBERO's class of a problem that compiles its scenes without images."""

    class WithoutImages(problem):  # type: ignore[misc]
        def _load_model(self) -> None:
            """Load the scene as LIBERO does; robosuite calls this method before it compiles a scene."""
            super()._load_model()
            self.set_xml_processor(self._leave_images_out)

        def _leave_images_out(self, xml: str) -> str:
            scene = ET.fromstring(xml)
            self.image_files = flat_images(scene)
            return ET.tostring(scene, encoding="unicode")

    # LIBERO compares the name of the class with the problem's name.
    WithoutImages.__name__ = problem.__name__
    return WithoutImages
