"""What a run made, as files for other programs: skinned and animated glTF, BVH, plain arrays."""

from __future__ import annotations

import io

import numpy as np

from tasks.errors import InputError
from tasks.export.bvh import write_bvh
from tasks.export.glb import Character, write_glb
from tasks.geometry import kinematics, rigid
from tasks.geometry.measure import diagonal
from tasks.geometry.skinning import skin
from tasks.values import Animation, Canonical, Files, Motion, Poses, Skeleton, Skinning

FOLDER = "export"  # in a report
CLOSE = 1e-4  # of the diagonal: points that lie this near are the same


def bones_glb(
    canonical: Canonical,
    skinning: Skinning,
    skeleton: Skeleton,
    motion: Motion,
    poses: Poses,
    animation: Animation | None = None,
    *,
    name: str,
) -> Files:
    """The free-form bones' rest shape on them, moving as the method says, or without one as fitted.

    motion: whose clips the frames are, for names and rate; the bones stand side by side, each at the centre of what it
    moves. A method that moves no bones gets :func:`skeleton_glb` instead; InputError where its points are not what the
    skeleton's weights make of the poses (BBW and fitted weights), as that file would show another method.
    """
    if animation is not None and animation.bones is None:
        posed = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
        off = np.abs(skin(canonical.points, skeleton.weights, posed) - animation.points).max()
        if off > CLOSE * diagonal(canonical.points):
            raise InputError(
                "export.formats",
                expected="a method that moves bones, or the skeleton with its own weights",
                found="glb: points that neither moves",
                do="take npz, which holds the points, or skeleton_glb, which holds the poses",
            )
        return skeleton_glb(canonical, skeleton, motion, poses, name=name)
    transforms = skinning.transforms if animation is None else animation.bones
    bones = transforms.shape[1]
    joints = _centres(skinning.rest, skinning.weights)
    character = Character(
        name=name,
        rest=skinning.rest,
        faces=canonical.faces,
        weights=skinning.weights,
        names=tuple(f"bone{b:03d}" for b in range(bones)),
        parents=np.full(bones, -1),
        joints=joints,
        rotations=transforms[..., :3],
        places=rigid.apply(transforms, joints),
        clips=_clips(motion),
        fps=motion.fps,
    )
    return Files.of({f"{FOLDER}/{name}_bones.glb": write_glb(character)})


def skeleton_glb(canonical: Canonical, skeleton: Skeleton, motion: Motion, poses: Poses, *, name: str) -> Files:
    """The canonical shape on the inner skeleton, by linear blend skinning."""
    up = np.asarray(skeleton.parents)
    offsets = skeleton.joints - np.where(up[:, None] < 0, 0, skeleton.joints[up])
    character = Character(
        name=name,
        rest=canonical.points,
        faces=canonical.faces,
        weights=skeleton.weights,
        names=skeleton.names,
        parents=up,
        joints=skeleton.joints,
        rotations=poses.rotations,
        places=poses.translations + offsets,
        clips=_clips(motion),
        fps=motion.fps,
    )
    return Files.of({f"{FOLDER}/{name}_skeleton.glb": write_glb(character)})


def skeleton_bvh(skeleton: Skeleton, motion: Motion, poses: Poses, *, name: str) -> Files:
    """The inner skeleton's poses, one file a clip."""
    clips = _clips(motion).items()
    return Files.of(
        {
            f"{FOLDER}/{name}_{clip}.bvh": write_bvh(skeleton, poses, frames, fps=motion.fps).encode()
            for clip, frames in clips
        }
    )


def points_npz(
    canonical: Canonical,
    motion: Motion,
    poses: Poses,
    skeleton: Skeleton,
    animation: Animation | None = None,
    *,
    name: str,
) -> Files:
    """Vertices (F, N, 3), faces, clips, and joint poses as plain arrays; `dataset=mesh_sequence` reads it again."""
    arrays = {
        "vertices": motion.points if animation is None else animation.points,
        "clip_start": motion.clip_start,
        "clip_names": np.array(list(_clips(motion))),
        "fps": np.array(motion.fps),
        "joint_names": np.array(skeleton.names),
        "joint_parents": np.asarray(skeleton.parents),
        "joints": skeleton.joints,
        "joint_rotations": poses.rotations,
        "joint_translations": poses.translations,
    }
    if canonical.faces is not None:
        arrays["faces"] = canonical.faces
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return Files.of({f"{FOLDER}/{name}.npz": stream.getvalue()})


def _clips(motion: Motion) -> dict[str, slice]:
    """Frames by names that can be file names, each once."""
    out: dict[str, slice] = {}
    for c, (clip, frames) in enumerate(zip(motion.clip_names, motion.clips(), strict=True)):
        safe = "".join(x if x.isalnum() or x in "-_." else "_" for x in clip) or "clip"
        out[safe if safe not in out else f"{safe}_{c}"] = frames
    return out


def _centres(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The mean of the points that a bone moves; of all points where it moves none. (B, 3)"""
    total = weights.sum(0, dtype=np.float64)
    mean = (weights.T.astype(np.float64) @ points) / np.maximum(total, 1e-12)[:, None]
    return np.where(total[:, None] > 1e-12, mean, points.mean(0)).astype(np.float32)
