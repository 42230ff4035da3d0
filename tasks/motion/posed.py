"""A run of poses as binding sees it: joints in the world and in the model, and what bones are stored relative to."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from tasks.geometry import kinematics, rigid
from tasks.geometry.measure import diagonal
from tasks.geometry.parallel import for_chunks
from tasks.geometry.rotations import to_quaternion
from tasks.motion.blending import PartMotion
from tasks.motion.dynamics import root_dynamics
from tasks.motion.frames import placed, seen_from
from tasks.motion.parts import bone_affinity
from tasks.motion.projection import project
from tasks.motion.search import Keys
from tasks.motion.skeletons import model_root, subtree
from tasks.values import Poses, Training

# Radians a unit of gravity direction, body diagonal/s, body diagonal/s^2 and rad/s: the weights of a prototype on
# clothing (0.3, 0.1 per m/s, 0.1 per g, 0.03 per rad/s) for a body whose bounding box has a diagonal of two metres.
DYNAMICS = np.array([0.3, 0.2, 0.02, 0.03])

FRAME_CHUNK = 128  # frames at once, which stay in the processor's cache


class Posed:
    """Training poses, or those of a query. Transforms are float64.

    world: (F, J, 3, 4) of the joints on canonical points;
    bones are handled as frames, [R | position of the bone's centroid], unrotated at rest. Blending positions of
    centroids, instead of translations of canonical points, keeps a bone where its sources have it even when their
    rotations differ.
    """

    def __init__(self, training: Training, poses: Poses, like: Posed | None = None) -> None:
        """like: other poses of the same training, whose centroids and affinities serve again."""
        skeleton = training.skeleton
        self.training, self.poses = training, poses
        self.root = like.root if like else model_root(skeleton)
        self.inner = like.inner if like else subtree(skeleton.parents)[self.root]
        self.world = kinematics.forward(
            np.asarray(skeleton.parents),
            skeleton.joints.astype(np.float64),
            poses.rotations.astype(np.float64),
            poses.translations.astype(np.float64),
        )
        self.centres = like.centres if like else centroids(training.skinning.rest, training.skinning.weights)
        if like:
            self.affinity = like.affinity
        self._keys: dict[tuple[int, float], Keys] = {}

    @cached_property
    def model(self) -> np.ndarray:
        """(F, J, 3, 4) the joints seen from the model's root."""
        return relative(self.world, self.world[:, self.root])

    @cached_property
    def quaternions(self) -> np.ndarray:
        """(F, J, 4) float32, of the local rotations."""
        return to_quaternion(self.poses.rotations).astype(np.float32)

    @cached_property
    def dynamics(self) -> np.ndarray:
        """(F, 4, 3) gravity, velocity, acceleration and angular velocity of the root, weighted to be compared."""
        pivot = self.training.skeleton.joints[self.root].astype(np.float64)
        return self.moving(self.world[:, self.root], pivot)

    def moving(self, transforms: np.ndarray, pivot: np.ndarray) -> np.ndarray:
        """The same (F, 4, 3) of anything that moves rigidly by (F, 3, 4), at the point that rests at ``pivot``."""
        size = diagonal(self.training.canonical.points)
        moving = root_dynamics(transforms, pivot, self.poses.clip_start, self.training.database.fps)
        return moving * (DYNAMICS / np.array([1.0, size, size, 1.0]))[:, None]

    @cached_property
    def affinity(self) -> np.ndarray:
        """(B, J) how much each free-form bone follows each joint."""
        return bone_affinity(self.training.skinning.weights, self.training.skeleton.weights)

    @cached_property
    def predicted(self) -> np.ndarray:
        """(F, B, 3, 4) where skinning of the skeleton would carry the bones' frames."""
        affinity = self.affinity
        frames, joints = self.world.shape[:2]
        out = np.empty((frames, len(affinity), 3, 4))

        def work(a: int, b: int) -> None:
            blended = (affinity @ self.world[a:b].reshape(b - a, joints, 12)).reshape(b - a, len(affinity), 3, 4)
            placed(blended, self.centres, out[a:b])
            out[a:b, :, :, :3] = project(out[a:b, :, :, :3])

        for_chunks(work, frames, FRAME_CHUNK)
        return out

    def key_joints(self, part: int) -> np.ndarray:
        """The part's joints below the model's root, which is left out: bones are stored relative to it. A part that
        has no other joint is compared by the root's."""
        joints = self.training.parts.joints[part]
        inner = joints & self.inner
        inner[self.root] = False
        return np.flatnonzero(inner if inner.any() else joints)

    def keys(self, part: int, dynamics: float) -> Keys:
        """What windows of a part are compared by; made once."""
        if (part, dynamics) not in self._keys:
            extra = dynamics * self.dynamics if dynamics > 0 else np.zeros((len(self.world), 0, 3))
            turns = self.quaternions[:, self.key_joints(part)]
            self._keys[part, dynamics] = Keys(turns, extra.astype(np.float32), self.poses.clip_start)
        return self._keys[part, dynamics]

    def to_part(self, transforms: np.ndarray, part: int, represent: str) -> np.ndarray:
        """Transforms in the model, (F, X, 3, 4), seen from where the part's bones are stored: from its root joint for
        ``part``, else from the model's own."""
        return relative(transforms, self._part_root(part)) if represent == "part" else transforms

    def from_part(self, transforms: np.ndarray, part: int, represent: str) -> np.ndarray:
        """The inverse of :meth:`to_part`."""
        return rigid.compose(self._part_root(part)[:, None], transforms) if represent == "part" else transforms

    def part_motion(self, part: int, represent: str) -> PartMotion:
        """Joints and anchor of a part, seen from its frame."""
        root = int(self.training.parts.roots[part])
        joints = self.training.parts.joints[part] & self.inner
        turns = to_quaternion(self.to_part(self.model[:, joints], part, represent)[..., :3])
        root_at = self.to_part(self.model[:, root, None], part, represent)[:, 0]
        return PartMotion(turns, rigid.apply(root_at, self.training.skeleton.joints[root].astype(np.float64)))

    def _part_root(self, part: int) -> np.ndarray:
        return self.model[:, int(self.training.parts.roots[part])]

    def encode(self, transforms: np.ndarray, represent: str) -> np.ndarray:
        """Transforms of bones on canonical points -> frames seen from the model's root or, as ``residual``, from where
        skinning would carry them. (F, B, 3, 4)."""
        base = self.predicted if represent == "residual" else self.world[:, self.root, None]
        out = np.empty(transforms.shape)

        def work(a: int, b: int) -> None:
            placed(transforms[a:b].astype(np.float64), self.centres, out[a:b])
            seen_from(base[a:b], out[a:b], out[a:b])

        for_chunks(work, len(out), FRAME_CHUNK)
        return out

    def decode(self, frames: np.ndarray, represent: str) -> np.ndarray:
        """The inverse of :meth:`encode`."""
        frames = rigid.compose(self.predicted if represent == "residual" else self.world[:, self.root, None], frames)
        rotation = frames[..., :3]
        return rigid.make(rotation, frames[..., 3] - (rotation @ self.centres[..., None])[..., 0])


def relative(transforms: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Transforms seen from a moving frame: (F, X, 3, 4) and (F, 3, 4) -> (F, X, 3, 4)."""
    return rigid.compose(rigid.inverse(frame)[:, None], transforms)


def centroids(rest: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, 3) points and (N, B) weights -> (B, 3) float64; the shape's own centroid for a bone of no weight."""
    mass = weights.astype(np.float64).sum(0)
    mean = (weights.astype(np.float64).T @ rest) / np.maximum(mass, 1e-12)[:, None]
    return np.where(mass[:, None] > 1e-9, mean, rest.mean(0, dtype=np.float64))
