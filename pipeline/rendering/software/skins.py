"""Rendering of large meshes by only the faces that a picture can show, with an index buffer for each mesh."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pipeline.rendering.software.faces import Faces, faces_of
from pipeline.rendering.software.mujoco_3_2_7.context import SKINS
from pipeline.rendering.software.mujoco_3_2_7.meshes import Meshes
from pipeline.rendering.software.mujoco_3_2_7.passes import OPAQUE
from pipeline.rendering.software.mujoco_3_2_7.skins import Skins
from pipeline.rendering.software.samples import Projection, faces_that_show, room

LEAST_FACES = 256
"""Meshes with fewer faces are rendered whole."""


class SkinnedMeshes:
    """Assignment of skins to the geoms of large meshes; a skin renders chosen faces of its geom's mesh.

    Args:
        skins: the context's skins.
        samples: (SAMPLES, 2) place of each sample in its pixel.
        model: the model.
        meshes: the display lists of its meshes.
        shown: (ngeom,) geoms that can be rendered, and whose faces may be chosen.
        former: the ``SkinnedMeshes`` of the context's former model; its faces are reused.
    """

    def __init__(
        self,
        skins: Skins,
        samples: NDArray[np.float32],
        model: mujoco.MjModel,
        meshes: Meshes,
        shown: NDArray[np.bool_],
        former: SkinnedMeshes | None = None,
    ):
        self._skins, self._samples, self._meshes = skins, samples, meshes
        self._mesh = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH, model.geom_dataid, -1)
        self._skin: NDArray[np.intp] = np.full(model.ngeom, -1, np.intp)
        self._faces: dict[bytes, Faces] = {}
        self._faces_of_geom: dict[int, Faces] = {}
        former_faces = former._faces if former else {}
        textured, plain = iter(range(SKINS)), iter(range(SKINS, 2 * SKINS))
        rendered = np.flatnonzero(shown & (self._mesh >= 0))
        for geom, mesh in zip(rendered.tolist(), self._mesh[rendered].tolist(), strict=True):
            if model.mesh_facenum[mesh] >= LEAST_FACES:
                content = meshes.contents[mesh]
                faces = self._faces.get(content) or former_faces.get(content) or faces_of(model, mesh)
                self._faces[content] = self._faces_of_geom[geom] = faces
                self._skin[geom] = next(plain if faces.texture is None else textured, -1)
                if self._skin[geom] >= 0:
                    skins.fill_vertices(int(self._skin[geom]), faces, content)
        # If one geom of a mesh has no skin, no geom of this mesh has a skin.
        meshes_without_skin = self._mesh[rendered[self._skin[rendered] < 0]]
        self._skin[np.isin(self._mesh, meshes_without_skin)] = -1
        most = max((room(len(faces.corners)) for faces in self._faces.values()), default=0)
        self._found: NDArray[np.uint32] = np.empty(most, np.uint32)

    def put(
        self, scene: mujoco.MjvScene, data: mujoco.MjData, projection: Projection, wanted: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Put the skins after their meshes into a scene, with the faces that a picture can show of ``wanted`` geoms.

        Args:
            scene: the updated scene.
            data: the state.
            projection: the picture's projection from the world.
            wanted: (ngeom,) geoms to render in the camera's passes.

        Returns:
            A mask (nmesh,) of the meshes whose skins are in the scene.
        """
        scene_geoms, of_mesh = self._skins.meshes_of_scene()
        geoms = np.where(of_mesh, scene_geoms["objid"], 0)
        skins = np.where(of_mesh, self._skin[geoms], -1)
        # MuJoCo renders transparent geoms last, and in a different order.
        transparent_meshes = self._mesh[geoms[of_mesh & (scene_geoms["rgba"][:, 3] < OPAQUE)]]
        skins[np.isin(self._mesh[geoms], transparent_meshes)] = -1
        if len(scene_geoms) + 2 * np.count_nonzero(skins >= 0) >= scene.maxgeom:
            skins[:] = -1
        for geom in geoms[skins >= 0].tolist():
            count = 0
            if wanted[geom]:
                of_geom = projection.from_frame(data.geom_xpos[geom], data.geom_xmat[geom])
                count = faces_that_show(of_geom, self._faces_of_geom[geom], self._samples, self._found)
            self._skins.fill_faces(int(self._skin[geom]), self._found[:count])
        meshes_with_skin = self._mesh[geoms[skins >= 0]]
        self._skins.follow(scene_geoms, skins, self._meshes.closing[meshes_with_skin])
        skinned = np.zeros(len(self._meshes.closing), np.bool_)
        skinned[meshes_with_skin] = True
        return skinned
