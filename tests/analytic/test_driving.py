"""A character driven by a file of poses: BVH read back, names matched in any order, limbs in line, clear refusals."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tasks.datasets import garments
from tasks.driving.bvh import read_bvh
from tasks.driving.drive import driving_poses, match_names
from tasks.errors import InputError
from tasks.export import bvh, character
from tasks.geometry import kinematics
from tasks.geometry.rotations import from_rotation_vector, geodesic
from tasks.values import Canonical, Motion, Poses, Skeleton

FPS = 30.0
NAMES = ("Hips", "Spine", "LeftArm", "LeftHand", "LeftLeg", "LeftFoot")
PARENTS = np.array([-1, 0, 1, 2, 0, 4])
T_POSE = np.array([[0, 1, 0], [0, 1.5, 0], [0.2, 1.5, 0], [0.9, 1.5, 0], [0.1, 0.9, 0], [0.1, 0, 0]], np.float32)


def skeleton(joints: np.ndarray = T_POSE) -> Skeleton:
    return Skeleton(NAMES, PARENTS, joints, np.eye(6, dtype=np.float32))


def walk(frames: int = 40) -> Poses:
    rng = np.random.default_rng(5)
    turns = from_rotation_vector(0.03 * np.cumsum(rng.normal(size=(frames, 6, 3)), axis=0))
    shift = np.zeros((frames, 6, 3))
    shift[:, 0] = np.linspace(0, 1, frames)[:, None] * [0.5, 0.2, 2.0]
    return Poses(turns.astype(np.float32), shift.astype(np.float32), np.array([0, frames]))


def training(frames: int = 40) -> Motion:
    points = np.zeros((frames, 6, 3), np.float32)
    return Motion("doll", points, None, np.array([0, frames]), ("a",), FPS, "m")


def drive(path, ours: Skeleton | None = None, **changed):
    return driving_poses(
        ours or skeleton(),
        training(),
        **{"path": str(path), "rename": [], "up": "y", "first": 0, "frames": None} | changed,
    )


def rejects(call, *says: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in says), message


def test_a_written_bvh_is_read_back(tmp_path):
    poses = walk()
    (tmp_path / "walk.bvh").write_text(bvh.write_bvh(skeleton(), poses, slice(0, 40), fps=FPS))
    read = read_bvh(tmp_path / "walk.bvh")
    assert read.names == NAMES
    np.testing.assert_array_equal(read.parents, PARENTS)
    assert read.fps == pytest.approx(FPS)
    assert geodesic(read.rotations, poses.rotations).max() < 1e-4
    np.testing.assert_allclose(read.joints[1:] - read.joints[0], T_POSE[1:] - T_POSE[0], atol=1e-5)
    np.testing.assert_allclose(
        read.joints[0] + read.translations[:, 0], T_POSE[0] + poses.translations[:, 0], atol=1e-5
    )


def test_channels_in_their_own_order(tmp_path):
    text = (
        "HIERARCHY ROOT a b { OFFSET 1 2 3 CHANNELS 4 Zposition Xrotation Zrotation Yrotation JOINT c { OFFSET 0 1 0 "
        "CHANNELS 0 End Site { OFFSET 0 1 0 } } }\nMOTION\nFrames: 1\nFrame Time: 0.05\n7 90 30 -50\n"
    )
    (tmp_path / "one.bvh").write_text(text)
    read = read_bvh(tmp_path / "one.bvh")
    angles = zip(np.radians([90, 30, -50]), np.eye(3)[[0, 2, 1]], strict=True)
    x, z, y = (from_rotation_vector(a * axis) for a, axis in angles)
    np.testing.assert_allclose(read.rotations[0, 0], x @ z @ y, atol=1e-12)
    assert read.names == ("a_b", "c")
    assert read.translations.tolist() == [[[0, 0, 4], [0, 0, 0]]]
    assert read.fps == pytest.approx(20)


def exported(path, poses: Poses, order: list[int]) -> None:
    """What the export writes, its joints in another order (parents still before children)."""
    moved = Motion("doll", np.zeros((40, 6, 3), np.float32), None, poses.clip_start, ("a",), FPS, "m")
    canonical = Canonical(T_POSE, None, -1, "doll")
    ((_, data),) = character.points_npz(canonical, moved, poses, skeleton(), name="doll").items()
    path.write_bytes(data)
    with np.load(path) as archive:
        arrays = dict(archive)
    place = np.argsort(order)
    parents = np.array([-1 if PARENTS[j] < 0 else place[PARENTS[j]] for j in order])
    arrays |= {n: arrays[n][order] for n in ("joint_names", "joints")} | {"joint_parents": parents}
    arrays |= {n: arrays[n][:, order] for n in ("joint_rotations", "joint_translations")}
    np.savez(path, **arrays)


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [0, 4, 5, 1, 2, 3]])
def test_our_own_poses_come_back_whatever_their_order(tmp_path, order):
    poses = walk()
    exported(tmp_path / "doll.npz", poses, order)
    motion, found, about = drive(tmp_path / "doll.npz")
    assert geodesic(found.rotations, poses.rotations).max() < 2e-3
    moved = found.translations[:, 0] - poses.translations[:, 0]  # as it was, but set on the ground
    np.testing.assert_allclose(moved, np.tile(moved[0], (40, 1)), atol=1e-4)
    assert motion.points[..., 1].min() == pytest.approx(0, abs=1e-4)
    assert about.notes == ("driven by doll, 40 frames",)
    few, _, _ = drive(tmp_path / "doll.npz", frames=7)
    np.testing.assert_array_equal(few.points, motion.points[:7])


def test_another_rest_pose_and_size_are_brought_into_line(tmp_path):
    """The driver stands in a T pose, twice our size; our arm hangs at rest, and our names have a prefix."""
    big = skeleton(2 * T_POSE)
    still = Poses(np.tile(np.eye(3, dtype=np.float32), (2, 6, 1, 1)), np.zeros((2, 6, 3), np.float32), np.array([0, 2]))
    still.translations[1, 0] = [1, 0, 4]
    (tmp_path / "t.bvh").write_text(bvh.write_bvh(big, still, slice(0, 2), fps=FPS))
    hanging = T_POSE.copy()
    hanging[3] = hanging[2] + [0, -0.7, 0]
    ours = Skeleton(tuple(f"mixamorig:{n.lower()}" for n in NAMES), PARENTS, hanging, np.eye(6, dtype=np.float32))
    motion, poses, _ = drive(tmp_path / "t.bvh", ours)
    np.testing.assert_allclose(motion.points[0], T_POSE, atol=1e-5)
    np.testing.assert_allclose(motion.points[1] - motion.points[0], np.tile([0.5, 0, 2], (6, 1)), atol=1e-5)
    turned = kinematics.forward(PARENTS, hanging, poses.rotations, poses.translations)
    np.testing.assert_allclose(kinematics.joint_positions(turned, hanging), motion.points, atol=1e-6)


def test_a_driver_that_looks_elsewhere_at_rest_turns_the_character(tmp_path):
    """Two bones that leave the hips decide which way the driver looks."""
    aside = (T_POSE @ from_rotation_vector(np.array([0.0, 1.2, 0.0])).T).astype(np.float32)
    still = Poses(np.tile(np.eye(3, dtype=np.float32), (2, 6, 1, 1)), np.zeros((2, 6, 3), np.float32), np.array([0, 2]))
    (tmp_path / "t.bvh").write_text(bvh.write_bvh(skeleton(aside), still, slice(0, 2), fps=FPS))
    motion, _, _ = drive(tmp_path / "t.bvh")
    np.testing.assert_allclose(motion.points[0] - motion.points[0, 0], aside - aside[0], atol=1e-4)


def test_limbs_of_a_driver_that_looks_backwards_turn_with_the_body(tmp_path):
    """Down is down wherever one looks: where the legs point does not tell that the thighs have turned as well."""
    back = (T_POSE * [-1, 1, -1]).astype(np.float32)
    still = Poses(np.tile(np.eye(3, dtype=np.float32), (2, 6, 1, 1)), np.zeros((2, 6, 3), np.float32), np.array([0, 2]))
    (tmp_path / "t.bvh").write_text(bvh.write_bvh(skeleton(back), still, slice(0, 2), fps=FPS))
    _, poses, _ = drive(tmp_path / "t.bvh")
    turned = kinematics.forward(PARENTS, T_POSE, poses.rotations, poses.translations)
    np.testing.assert_allclose(turned[0, :, :, :3], np.tile(np.diag([-1.0, 1, -1]), (6, 1, 1)), atol=1e-5)


def test_hip_joints_that_lie_elsewhere_do_not_tilt_the_body(tmp_path):
    """The driver's legs begin before its hips, ours below them: both stand, and so does what is driven."""
    before = T_POSE.copy()
    before[4:, 2] += 0.06
    still = Poses(np.tile(np.eye(3, dtype=np.float32), (2, 6, 1, 1)), np.zeros((2, 6, 3), np.float32), np.array([0, 2]))
    turn = from_rotation_vector(np.array([0.0, 0.8, 0.0]))
    (tmp_path / "t.bvh").write_text(
        bvh.write_bvh(skeleton((before @ turn.T).astype(np.float32)), still, slice(0, 2), fps=FPS)
    )
    _, poses, _ = drive(tmp_path / "t.bvh")
    np.testing.assert_allclose(poses.rotations[0, 0][:, 1], [0, 1, 0], atol=1e-6)
    assert geodesic(poses.rotations[0, 0], turn) < geodesic(np.eye(3), turn)


def nested(pose: Poses) -> str:
    """A BVH whose root, a node on the ground, stands still, while the hips carry the path."""
    text = bvh.write_bvh(skeleton(), pose, slice(0, len(pose.rotations)), fps=FPS)
    head, motion = text.split("MOTION")
    still = "HIERARCHY\nROOT Reference\n{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition Zposition " + (
        "Zrotation Xrotation Yrotation\n"
    )
    inner = head.removeprefix("HIERARCHY").replace("ROOT Hips", "JOINT Hips")
    counts, rows = motion.split("\n")[1:3], motion.split("\n")[3:-1]
    return "\n".join([still + inner + "}", "MOTION", *counts, *(f"0 0 0 0 0 0 {row}" for row in rows)]) + "\n"


def test_the_path_of_the_hips_counts_though_they_hang_on_another_node(tmp_path):
    poses = walk()
    poses.translations[20, 0, 1] += 3  # a jump
    (tmp_path / "plain.bvh").write_text(bvh.write_bvh(skeleton(), poses, slice(0, 40), fps=FPS))
    (tmp_path / "nested.bvh").write_text(nested(poses))
    plain, _, _ = drive(tmp_path / "plain.bvh")
    below, _, about = drive(tmp_path / "nested.bvh")
    assert np.ptp(plain.points[:, 0, 1]) > 2.5
    np.testing.assert_allclose(below.points, plain.points, atol=1e-4)
    assert len(about.notes) == 1


def test_a_file_whose_z_is_up(tmp_path):
    poses = walk()
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # x y z with Y up -> x -z y
    lying = Poses((turn @ poses.rotations @ turn.T).astype(np.float32), poses.translations @ turn.T, poses.clip_start)
    on_its_back = skeleton((T_POSE @ turn.T).astype(np.float32))
    (tmp_path / "y.bvh").write_text(bvh.write_bvh(skeleton(), poses, slice(0, 40), fps=FPS))
    (tmp_path / "z.bvh").write_text(bvh.write_bvh(on_its_back, lying, slice(0, 40), fps=FPS))
    upright, _, _ = drive(tmp_path / "y.bvh")
    motion, _, about = drive(tmp_path / "z.bvh", up="z")
    np.testing.assert_allclose(motion.points, upright.points, atol=1e-4)
    assert len(about.notes) == 1
    _, _, about = drive(tmp_path / "z.bvh")
    assert "drive.up=z" in about.notes[1]


@pytest.mark.parametrize(
    ("theirs", "ours", "matched"),
    [
        ("mixamorig:LeftArm", "LeftArm", True),
        ("mixamorig_LeftArm", "left_arm", True),
        ("arm.L", "LeftArm", True),
        ("R_Arm", "rightArm", True),
        ("LArm", "LeftArm", True),
        ("arm.R", "LeftArm", False),
        ("Spine1", "Spine", False),
        ("骨盆", "Hüfte", False),  # names of no Latin letter are names all the same
        ("骨盆", "骨盆", True),
    ],
)
def test_names_as_other_programs_write_them(theirs, ours, matched):
    two = Skeleton(("Hips", ours), np.array([-1, 0]), T_POSE[:2], np.eye(2, dtype=np.float32))
    assert match_names(two, ("hips", theirs), [], where="").tolist() == [0, 1 if matched else -1]


def test_texts_that_programs_write_differently(tmp_path):
    good = bvh.write_bvh(skeleton(), walk(), slice(0, 40), fps=FPS)
    (tmp_path / "w.bvh").write_text(good)
    plain, _, _ = drive(tmp_path / "w.bvh")
    for text in (good.replace("\n", "\r\n"), "\ufeff" + good, good.replace("\n", "\n\n"), good.replace("  ", "\t")):
        (tmp_path / "w.bvh").write_bytes(text.encode())
        other, _, _ = drive(tmp_path / "w.bvh")
        np.testing.assert_array_equal(other.points, plain.points)
    (tmp_path / "w.bvh").write_text(good.replace("ROOT Hips", "ROOT LOCOMOTION_Hips"))
    assert read_bvh(tmp_path / "w.bvh").names[0] == "LOCOMOTION_Hips"


def test_joints_without_a_counterpart_stay_at_rest_and_are_named(tmp_path):
    (tmp_path / "w.bvh").write_text(bvh.write_bvh(skeleton(), walk(), slice(0, 40), fps=FPS))
    odd = Skeleton(
        ("Hips", "Spine", "LeftArm", "Paw", "LeftLeg", "LeftFoot"), PARENTS, T_POSE, np.eye(6, dtype=np.float32)
    )
    _, poses, about = drive(tmp_path / "w.bvh", odd)
    np.testing.assert_allclose(poses.rotations[:, 3], np.tile(np.eye(3), (40, 1, 1)), atol=1e-6)
    assert about.notes[1] == "joints left at rest: Paw"
    _, renamed, about = drive(tmp_path / "w.bvh", odd, rename=["LeftHand=Paw"])
    assert len(about.notes) == 1
    assert geodesic(renamed.rotations[:, 3], poses.rotations[:, 3]).max() > 0.05


def test_bad_files_and_names(tmp_path):
    good = bvh.write_bvh(skeleton(), walk(), slice(0, 40), fps=FPS)
    path = tmp_path / "w.bvh"
    path.write_text(good)
    rejects(lambda: drive(tmp_path / "none.bvh"), "no such file")
    rejects(
        lambda: driving_poses(skeleton(), training(), path=None, rename=[], up="y", first=0, frames=None),
        "drive.path=FILE",
    )
    rejects(lambda: drive(path, first=40), "drive.first", "at most 39")
    rejects(lambda: drive(path, rename=["LeftHand=Nose"]), "drive.rename", "LeftFoot", "'LeftHand=Nose'")
    cat = Skeleton(("root", "b", "c", "d", "e", "f"), PARENTS, T_POSE, np.eye(6, dtype=np.float32))
    rejects(lambda: drive(path, cat), "root, b, c", "0 of 6 among Hips, Spine", "drive.rename")
    fewer = Skeleton(NAMES[:2], PARENTS[:2], T_POSE[:2], np.eye(2, dtype=np.float32))
    assert match_names(fewer, NAMES, [], where="").tolist() == [0, 1]  # a skeleton of fewer joints takes its own
    for text, words in (
        ("{}", "a BVH file"),
        (good.replace("Frames: 40", "Frames: 41"), "41 frames of 21 numbers"),
        (good[:-30], "numbers"),
        (good.replace("CHANNELS 3", "CHANNELS x", 1), "damaged text"),
        (good.replace("Zrotation", "Wrotation", 1), "unknown channel 'Wrotation'"),
        (good.rpartition(" ")[0] + " nan\n", "others in frame 39"),
        (good.replace("OFFSET", "OFSET", 1), "damaged text"),
        (good.replace("CHANNELS 3", "CHANNELS -2", 1), "-2 channels"),
        (good.replace("OFFSET 0.000000", "OFFSET nan", 1), "an OFFSET that is not finite"),
        (good.replace("}\nMOTION", "MOTION"), "no end of joint 'Hips'"),
        (good.replace("Frames: 40", "Frames: 0"), "1 frames of 21 numbers, and a frame time, found"),
        (re.sub("Frame Time: .*", "Frame Time: inf", good), "a frame time"),
    ):
        path.write_text(text)
        rejects(lambda: drive(path), "w.bvh", words)
    path.write_text(re.sub("Frame Time: .*", "Frame Time: 1e30", good))
    rejects(lambda: drive(path), "frame time", "at most 10 s")
    exported(tmp_path / "p.npz", walk(), list(range(6)))
    with np.load(tmp_path / "p.npz") as archive:
        arrays = dict(archive)
    for change, words in (
        ({"joint_rotations": 2 * arrays["joint_rotations"]}, ("joint_rotations", "rotation matrices", "frame 0")),
        ({"joint_rotations": arrays["joint_rotations"][:, :4]}, ("arrays of 6 joints",)),
        ({"joints": None}, ("add joints",)),
        ({"joints": arrays["joints"] * np.nan}, ("joints", "finite numbers")),
        ({"joint_parents": arrays["joint_parents"][::-1]}, ("joint_parents", "every parent before")),
        ({"fps": np.array(0.0)}, ("fps", "above zero")),
    ):
        np.savez(tmp_path / "bad.npz", **{n: a for n, a in (arrays | change).items() if a is not None})
        rejects(lambda: drive(tmp_path / "bad.npz"), "bad.npz", *words)


def test_a_capture_drives_the_body_of_the_garments(shared_data):
    motion = garments.load(garment="tshirt", path="data/garments", weights="nearest")
    rig = motion.rig
    ours = Skeleton(rig.names, rig.parents, rig.joints, rig.weights)
    path = shared_data / "mocap_cmu" / "01_01.bvh"
    made, _, about = driving_poses(ours, motion, path=str(path), rename=[], up="y", first=0, frames=None)
    assert made.frames == 688  # 2,752 at 120 a second
    assert about.notes[1] == "joints left at rest: Spine2"
    assert made.points[..., 1].min() == pytest.approx(rig.joints[:, 1].min(), abs=1e-4)
    hips, head = (made.points[:, rig.names.index(n)] for n in ("Hips", "Head"))
    assert np.percentile(head[:, 1] - hips[:, 1], 5) > 0.3  # upright
    assert 3 < made.points[-1, 0, 2] - made.points[0, 0, 2] < 6  # jumps forward, metres
    step = np.linalg.norm(np.diff(made.points, axis=0), axis=2) * motion.fps
    assert step[0].max() > 15  # the file begins with a T pose, as captures do
    assert step[1:].max() < 9
    later, _, _ = driving_poses(ours, motion, path=str(path), rename=[], up="y", first=1, frames=5)
    np.testing.assert_allclose(later.points[..., 1], made.points[1:6, :, 1], atol=0.05)
