"""LIBERO's own environment, for comparisons.

robosuite selects its renderer by ``MUJOCO_GL`` when it is imported, so this module chooses the renderer before.
"""

from importlib import import_module

from pipeline import gl

gl.choose()

OffScreenRenderEnv = import_module("libero.libero.envs").OffScreenRenderEnv
transform = import_module("robosuite.utils.transform_utils")
"""Rotations of robosuite."""
