"""Scenes whose images are left out, compared with the MJCF that MuJoCo writes of the scene with its images."""

import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from pipeline.errors import PipelineError
from pipeline.scenes.flat_images import flat_images, restore_images

TEXTURES = (
    'name="a" type="2d" file="{file}"',
    'name="a" file="{file}"',
    'name="a" type="cube" file="{file}"',
    'name="a" type="2d" file="{file}" width="7" height="5"',
    'name="a" type="2d" file="{folder}/../{folder_name}/image.png"',
    'name="a" type="cube" file="{file}" gridsize="2 2" gridlayout=".U.."',
    'name="a" type="2d" file="{file}" hflip="true"',
    'name="a" type="2d" file="{file}" rgb1="1 0 0"',
    'name="a" type="2d" file="{file}" content_type="image/png"',
    'name="a" type="2d" builtin="checker" width="4" height="4" file="{file}"',
    'name="a" type="2d" builtin="checker" width="4" height="4"',
    'type="skybox" builtin="gradient" width="4" height="4"',
)


def written(xml: str) -> str:
    """Return the MJCF that MuJoCo writes of a scene."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.compile()
    text: str = spec.to_xml()
    return ET.tostring(ET.fromstring(text), encoding="unicode")


@pytest.mark.parametrize("texture", TEXTURES)
def test_images_come_back_as_mujoco_writes_them(texture: str, tmp_path: Path) -> None:
    file = tmp_path / "image.png"
    cv2.imwrite(str(file), np.zeros((8, 8, 3), np.uint8))
    filled = texture.format(file=file, folder=tmp_path, folder_name=tmp_path.name)
    xml = f"<mujoco><asset><texture {filled}/></asset></mujoco>"
    scene = ET.fromstring(xml)
    files = flat_images(scene)
    of_mujoco = ET.fromstring(written(ET.tostring(scene, encoding="unicode")))
    restore_images(of_mujoco, files)
    assert ET.tostring(of_mujoco, encoding="unicode") == written(xml)


def test_a_missing_image_is_named(tmp_path: Path) -> None:
    file = tmp_path / "missing.png"
    scene = ET.fromstring(f'<mujoco><asset><texture name="a" type="2d" file="{file}"/></asset></mujoco>')
    files = flat_images(scene)
    with pytest.raises(PipelineError, match="does not exist") as caught:
        restore_images(scene, files)
    assert str(caught.value.where) == str(file)
