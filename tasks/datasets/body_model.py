"""A body model of SMPL's layout, which the user brings along: joints of a body shape, and its posed skin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tasks.datasets import validate
from tasks.datasets.rigging import check_tree
from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.rotations import from_rotation_vector
from tasks.geometry.skinning import skin

KEYS = ("v_template", "f", "weights", "kintree_table", "J_regressor")
SMPL = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle"),
    *("spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder"),
    *("right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand"),
)


@dataclass(frozen=True)
class Body:
    """One body of the model. names: J; parents: (J,) int32; joints: (J, 3); vertices: (V, 3) at rest; faces: (T, 3);
    weights: (V, J)."""

    names: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray

    def posed(self, rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
        """The skin in poses (F, J, 3, 3), (F, J, 3), without SMPL's pose-dependent shape. (F, V, 3)"""
        transforms = kinematics.forward(self.parents, self.joints, rotations, translations)
        return skin(self.vertices, self.weights, transforms)


def read_body(path: Path, shape: np.ndarray) -> Body:
    """The model's body of that shape. path: SMPL's .npz, with v_template (V, 3), f (T, 3), weights (V, J),
    kintree_table (2, J), J_regressor (J, V) and perhaps shapedirs (V, 3, S); shape: (S',) coefficients.

    Raises InputError where an array is missing or does not fit the others.
    """
    data = validate.read_npz(path, required=KEYS, optional=("shapedirs",))
    vertices = validate.real(f"{path}: v_template", data["v_template"], shape="(vertices, 3)", last=3)
    weights, regressor = data["weights"], data["J_regressor"]
    count, joints = len(vertices), data["kintree_table"].shape[-1]
    for name, array, wanted in (("weights", weights, (count, joints)), ("J_regressor", regressor, (joints, count))):
        if array.shape != wanted or array.dtype.kind not in "fiu":
            raise InputError(f"{path}: {name}", expected=f"numbers of shape {wanted}", found=f"{array.shape}")
    if "shapedirs" in data:
        used = min(len(shape), data["shapedirs"].shape[-1])
        vertices = vertices + (data["shapedirs"][..., :used] @ shape[:used]).astype(np.float32)
    parents = data["kintree_table"][0].astype(np.int64)
    parents[(parents < 0) | (parents >= joints)] = -1  # SMPL writes the root's as 2^32 - 1
    check_tree(f"{path}: kintree_table", parents)
    names = SMPL if joints == len(SMPL) else tuple(f"joint{j:02d}" for j in range(joints))
    return Body(
        names,
        parents.astype(np.int32),
        (regressor @ vertices).astype(np.float32),
        vertices.astype(np.float32),
        validate.triangles(f"{path}: f", data["f"].astype(np.int64), count),
        (weights / weights.sum(1, keepdims=True)).astype(np.float32),
    )


def poses_of(turns: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SMPL's axis-angle vectors (F, 3 J) and translation (F, 3) -> rotations (F, J, 3, 3), translations (F, J, 3)."""
    vectors = turns.reshape(len(turns), -1, 3).astype(np.float64)
    translations = np.zeros(vectors.shape, np.float32)
    translations[:, 0] = shift
    return from_rotation_vector(vectors).astype(np.float32), translations
