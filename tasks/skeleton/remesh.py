"""Even triangles by isotropic remeshing: the one place that calls pymeshlab (GPL), loaded only when needed."""

from __future__ import annotations

import numpy as np

from tasks.skeleton.manifold import components_of, is_closed

_ROUNDS = 5


def to_count(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` vertices on the same closed surface (Botsch & Kobbelt 2004). vertices: (V, 3); faces: (T, 3).

    Thin parts can tear while edges collapse; then finer meshes are tried, and at last the input is handed back.
    """
    import pymeshlab

    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    for finer in (1.0, 0.7, 0.5):
        length = finer * np.sqrt(2.0 / np.sqrt(3.0) * area / count)
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
        meshes.meshing_isotropic_explicit_remeshing(
            iterations=_ROUNDS, targetlen=pymeshlab.PureValue(length), featuredeg=180.0, checksurfdist=False
        )
        mesh = meshes.current_mesh()
        new_vertices, new_faces = mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64)
        if is_closed(new_faces, len(new_vertices)) and components_of(new_faces, len(new_vertices))[0] == 1:
            return new_vertices, new_faces
    return vertices, faces
