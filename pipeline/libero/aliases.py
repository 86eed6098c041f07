"""Objects that had other names when LIBERO's demonstrations were recorded than in today's BDDL files."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping

from pipeline.libero import bddl
from pipeline.types import Task

RECORDED_AS = {"new_salad_dressing": "salad_dressing"}
"""Category in BDDL files to the category in recordings; from LIBERO-90's LIVING_ROOM_SCENE4."""


def as_defined(model_xml: str, task: Task) -> str:
    """Rename the objects of a recorded scene to their names in the task's BDDL file.

    For example, ``salad_dressing_1`` becomes ``new_salad_dressing_1``. Files of assets keep their names. A scene
    without such an object is returned unchanged.
    """
    renamed = {old: new for old, new in _recorded_names(task).items() if f'"{old}_main"' in model_xml}
    if not renamed:
        return model_xml
    root = ET.fromstring(model_xml)
    for element in root.iter():
        for attribute, value in element.items():
            if not attribute.startswith("file"):
                element.set(attribute, _renamed(value, renamed))
    return ET.tostring(root, encoding="unicode")


def _recorded_names(task: Task) -> dict[str, str]:
    """Return the differing names: name of an object in recordings to its name in the task's BDDL file."""
    objects = bddl.read(task.bddl_file).objects
    names = {}
    for name, category in objects.items():
        if category in RECORDED_AS:
            recorded = RECORDED_AS[category] + name.removeprefix(category)
            if recorded not in objects:
                names[recorded] = name
    return names


def _renamed(value: str, names: Mapping[str, str]) -> str:
    """Rename an object in a name of MJCF, which begins with the object's name."""
    for old, new in names.items():
        if f"{value}_".startswith(f"{old}_"):
            return new + value.removeprefix(old)
    return value
