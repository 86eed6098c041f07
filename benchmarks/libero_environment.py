"""LIBERO's own environment, for comparisons.

robosuite renders with what ``MUJOCO_GL`` names when it is imported, so this module chooses the renderer before.
"""

from importlib import import_module

from pipeline import gl

gl.choose()

OffScreenRenderEnv = import_module("libero.libero.envs").OffScreenRenderEnv
transform = import_module("robosuite.utils.transform_utils")
"""Rotations of robosuite."""
