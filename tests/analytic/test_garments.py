"""Making garments: captured motion, retargeting, cutting, checks, 16-bit storage, transferred weights."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from tasks.errors import InputError
from tasks.garments import capture, check, pack, pattern, retarget
from tasks.garments.simulate import carried
from tasks.geometry import kinematics
from tasks.geometry.quantise import decode, encode
from tasks.geometry.rotations import from_rotation_vector, geodesic
from tasks.geometry.weight_transfer import nearest_weights, robust_weights
from tasks.values import Canonical, Cloth, Motion, Poses, Rig

UP, AHEAD, LEFT = np.eye(3)[[1, 2, 0]]
LIMBS = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
SPINE = ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")
NAMES = [*SPINE, *(side + limb for half in (LIMBS[:4], LIMBS[4:]) for side in ("Left", "Right") for limb in half)]
PARENTS = np.array([-1, 0, 1, 2, 3, 4, 3, 6, 7, 8, 3, 10, 11, 12, 0, 14, 15, 16, 0, 18, 19, 20], np.int32)


@pytest.fixture(scope="module")
def stick_body() -> Motion:
    """A rig of the body's names, arms at 45 degrees, with one vertex at every joint."""
    step = {"Spine": UP, "Neck": UP, "Head": UP, "UpLeg": 0.1 * LEFT, "Leg": -0.4 * UP, "Foot": -0.4 * UP}
    step |= {"ToeBase": 0.1 * AHEAD - 0.05 * UP, "Shoulder": 0.1 * LEFT, "Arm": 0.1 * LEFT}
    step |= {"ForeArm": 0.2 * (LEFT - UP), "Hand": 0.2 * (LEFT - UP)}
    joints = np.zeros((len(NAMES), 3))
    for j, (name, parent) in enumerate(zip(NAMES, PARENTS, strict=True)):
        part = name.removeprefix("Left").removeprefix("Right").rstrip("12")
        offset = step.get(part, np.zeros(3)) * (0.15 if part in ("Spine", "Neck", "Head") else 1.0)
        mirror = np.array([-1.0 if name.startswith("Right") else 1.0, 1.0, 1.0])
        joints[j] = np.array([0, 0.85, 0]) if parent < 0 else joints[parent] + offset * mirror
    joints = joints.astype(np.float32)
    weights = np.eye(len(NAMES), dtype=np.float32)
    still = np.tile(np.eye(3, dtype=np.float32), (1, len(NAMES), 1, 1))
    rig = Rig(tuple(NAMES), PARENTS, joints, weights, still, np.zeros((1, len(NAMES), 3), np.float32))
    faces = np.array([[0, 1, 2]], np.int32)
    return Motion("stick", joints[None], faces, np.array([0, 1]), ("rest",), 30.0, "m", joints, rig)


def text_of(frames: list[dict], seconds: float = 0.1) -> str:
    """A DeepMimic clip; a frame names the joints that are not at rest, `at` the root's position."""
    rows = []
    for frame in frames:
        row = np.zeros(capture.COLUMNS)
        row[0] = seconds
        row[1:4] = frame.get("at", (0, 0.89, 0))
        for name, _, first, width in capture.LINKS:
            row[first : first + width] = frame.get(name, (1, 0, 0, 0) if width == 4 else 0)
        rows.append(row.tolist())
    return json.dumps({"Frames": rows})


def captured(frames: list[dict], cycles: float = 1.0) -> capture.Capture:
    times, local, root = capture.parse(text_of(frames), where="test")
    return capture._sample(times, local, root, cycles=cycles, fps=30.0)


def directions(body: Motion, poses: Poses, upper: str, lower: str) -> np.ndarray:
    rig = body.rig
    transforms = kinematics.forward(rig.parents, rig.joints, poses.rotations, poses.translations)
    at = kinematics.joint_positions(transforms, rig.joints)
    bone = at[:, rig.names.index(lower)] - at[:, rig.names.index(upper)]
    return bone / np.linalg.norm(bone, axis=1, keepdims=True)


class TestCapture:
    def test_axes(self):
        _, local, root = capture.parse(text_of([{"at": (1, 2, 3)}] * 2), where="test")
        np.testing.assert_allclose(root[0], [-3, 2, 1])  # ahead is +Z, right is -X
        np.testing.assert_allclose(local, np.broadcast_to(np.eye(3), local.shape), atol=1e-12)

    def test_elbow_bends_forward_and_knee_backward(self, stick_body):
        bent = captured([{"left_elbow": np.pi / 2, "right_knee": -np.pi / 2}] * 2)
        poses = retarget.retarget(stick_body, bent, spread=0.0)
        np.testing.assert_allclose(directions(stick_body, poses, "LeftArm", "LeftForeArm")[0], -UP, atol=1e-5)
        np.testing.assert_allclose(directions(stick_body, poses, "LeftForeArm", "LeftHand")[0], AHEAD, atol=1e-5)
        np.testing.assert_allclose(directions(stick_body, poses, "RightLeg", "RightFoot")[0], -AHEAD, atol=1e-5)
        np.testing.assert_allclose(directions(stick_body, poses, "LeftLeg", "LeftFoot")[0], -UP, atol=1e-5)

    def test_a_loop_goes_on_where_it_was(self):
        half = np.radians(20) / 2
        turned = (np.cos(half), 0, np.sin(half), 0)
        step = [{"at": (0, 0.9, 0)}, {"at": (0.5, 1.0, 0)}, {"at": (1, 0.95, 0), "root": turned}]
        once, twice = captured(step), captured(step, cycles=2.0)
        assert len(twice.root) == 2 * len(once.root) - 1
        first, second = np.diff(once.root[[0, -1]], axis=0)[0], twice.root[-1] - twice.root[len(once.root) - 1]
        turn = from_rotation_vector(np.radians(20) * UP)
        np.testing.assert_allclose(second[[0, 2]], (turn @ first)[[0, 2]], atol=1e-9)
        assert abs(twice.root[-1, 1] - 0.9) < 1e-9  # the rise of the cycle is closed, or loops would fly away
        assert np.linalg.norm(np.diff(twice.root, axis=0), axis=1).max() < 0.2  # no jump at the seam

    def test_bend_makes_a_circle(self):
        speed, rate, frames = 1.5, np.pi / 2, 121
        root = np.arange(frames)[:, None] * speed / 30 * AHEAD
        straight = capture.Capture(np.tile(np.eye(3), (frames, 13, 1, 1)), root, 30.0)
        bent = capture.bend(straight, rate)
        assert np.linalg.norm(bent.root[-1] - bent.root[0]) < 0.06  # four seconds at 90 degrees a second: one round
        across = np.ptp(bent.root[:, 0])
        np.testing.assert_allclose(across, 2 * speed / rate, rtol=0.01)
        ahead = bent.local[30, 0] @ AHEAD
        np.testing.assert_allclose(ahead, LEFT, atol=1e-9)

    def test_bad_clip(self):
        with pytest.raises(InputError, match="44 numbers"):
            capture.parse(json.dumps({"Frames": [[0.1, 2.0], [0.1, 3.0]]}), where="bad.txt")


class TestRetarget:
    def test_hanging_arms_stand_off(self, stick_body):
        poses = retarget.retarget(stick_body, captured([{}] * 2), spread=20.0)
        for side, sign in (("Left", 1), ("Right", -1)):
            expected = sign * np.sin(np.radians(20)) * LEFT - np.cos(np.radians(20)) * UP
            np.testing.assert_allclose(
                directions(stick_body, poses, f"{side}Arm", f"{side}Hand")[0], expected, atol=1e-5
            )
        assert np.abs(poses.translations).max() < 1e-6  # standing: hips where the body's own are

    def test_lead_in_joins_without_a_jump(self, stick_body):
        moving = [{"at": (0.02 * k, 0.89, 0), "left_elbow": 0.05 * k} for k in range(20)]
        poses = retarget.retarget(stick_body, captured(moving), spread=10.0)
        led = retarget.lead_in(stick_body, poses, spread=25.0, fps=30.0, speed=1.5)
        lead = int(led.clip_start[1])
        np.testing.assert_array_equal(led.rotations[lead:], poses.rotations)
        rig = stick_body.rig
        transforms = kinematics.forward(rig.parents, rig.joints, led.rotations, led.translations)
        at = kinematics.joint_positions(transforms, rig.joints)
        steps = np.linalg.norm(np.diff(at, axis=0), axis=2)
        before, after = steps[lead - 1], steps[lead + 1]
        assert np.abs(before - after).max() < 0.01  # metres a frame
        stand = retarget.zero_pose(stick_body, spread=25.0)
        assert geodesic(led.rotations[0, 0], stand[0]) < 1e-5

    def test_cloth_is_carried_with_the_hips(self, stick_body):
        poses = retarget.retarget(stick_body, captured([{"at": (2, 0.89, 1)}] * 2), spread=25.0)
        hips = stick_body.rig.joints[0]
        cloth = carried(Cloth(hips[None] + LEFT, LEFT[None]), stick_body, poses)
        np.testing.assert_allclose(cloth.points[0] - LEFT, poses.translations[0, 0] + hips, atol=1e-5)


class TestPattern:
    @pytest.fixture
    def sheet(self):
        x, y = np.meshgrid(np.linspace(0, 1, 11), np.linspace(0, 1, 11), indexing="ij")
        points = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
        corner = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
        faces = np.concatenate(
            [np.stack([corner, corner + 11, corner + 12], 1), np.stack([corner, corner + 12, corner + 1], 1)]
        )
        return points, faces

    def test_clip_leaves_the_exact_area(self, sheet):
        points, faces = sheet
        kept = trimesh.Trimesh(*pattern.clip(points, faces, 0.335 - points[:, 0] - 0.2 * points[:, 1]), process=False)
        assert kept.area == pytest.approx(0.335 - 0.1)
        assert kept.is_winding_consistent
        assert kept.euler_number == 1

    def test_short_edges_go(self, sheet):
        points, faces = pattern.clip(*sheet, 0.301 - sheet[0][:, 0])  # leaves a column of edges of 1 mm
        points, faces = pattern.collapse_short(points, faces, 0.04)
        mesh = trimesh.Trimesh(points, faces, process=False)
        assert mesh.edges_unique_length.min() >= 0.04
        assert mesh.euler_number == 1
        assert mesh.area == pytest.approx(0.301, abs=0.01)

    def test_radius_of_a_hull(self):
        angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        unit = np.stack([np.cos(angle), np.sin(angle)], 1)
        square = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1.0]])
        radius = pattern.radius_of_hull((square @ unit.T).max(0), unit)
        np.testing.assert_allclose(radius, 1 / np.abs(unit).max(1), rtol=1e-6)


class TestCheck:
    def test_depth_in_a_ball(self):
        ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
        depth = check.depth_in(ball.vertices, ball.faces, np.array([[0.9, 0, 0], [0, 1.2, 0], [0, 0, 0]]))
        np.testing.assert_allclose(depth, [0.1, -0.2, 1.0], atol=0.003)

    def test_strain_of_a_stretched_sheet(self):
        rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
        strain = check.strain(np.stack([rest, 1.1 * rest, rest * [1, 0.5, 1]]), rest, np.array([[0, 1, 2]]))
        np.testing.assert_allclose(strain[0], 0, atol=1e-12)
        np.testing.assert_allclose(strain[1], 0.1)
        assert sorted(np.round(strain[2], 3)) == [-0.5, round(np.sqrt(1.25 / 2) - 1, 3), 0]


class TestStorage:
    def test_error_is_half_a_step_and_clips_stand_apart(self):
        rng = np.random.default_rng(0)
        points = np.cumsum(rng.normal(scale=0.01, size=(60, 9, 3)), axis=0)
        points[7], points[8] = 3.2, -3.2  # the largest jumps wrap round and come back
        start = np.array([0, 25, 60])
        codes = encode(points, start, 1e-4)
        assert codes.dtype == np.uint8
        assert np.abs(decode(codes, start, 1e-4) - points).max() <= 0.5e-4 + 1e-12
        alone = decode(codes[:, 25:], np.array([0, 35]), 1e-4)
        np.testing.assert_array_equal(alone, decode(codes, start, 1e-4)[25:])

    def test_out_of_range(self):
        with pytest.raises(InputError, match=r"within 3.2767"):
            encode(np.full((2, 1, 3), 4.0), np.array([0, 2]), 1e-4)

    def test_body_and_garment_come_back(self, stick_body, tmp_path):
        from tasks.datasets import garments

        rng = np.random.default_rng(1)
        turns = from_rotation_vector(rng.normal(scale=0.4, size=(12, len(NAMES), 3))).astype(np.float32)
        shift = np.zeros((12, len(NAMES), 3), np.float32)
        shift[:, 0] = rng.normal(size=(12, 3))
        poses = Poses(turns, shift, np.array([0, 12]))
        cutting = retarget.to_poses(PARENTS, retarget.zero_pose(stick_body, spread=65.0)[None], np.zeros((1, 3)))
        np.savez(tmp_path / "body.npz", **pack.body_arrays(stick_body, cutting))
        posed = kinematics.forward(PARENTS, stick_body.rig.joints, cutting.rotations, cutting.translations)
        rest = kinematics.joint_positions(posed, stick_body.rig.joints)[0]
        moved = kinematics.forward(PARENTS, stick_body.rig.joints, turns, shift)
        points = kinematics.joint_positions(moved, stick_body.rig.joints)
        garment = Canonical(rest.astype(np.float32), stick_body.faces, -1, "tshirt")
        clips = [
            ("a", Poses(turns[:5], shift[:5], None), points[:5]),
            ("b", Poses(turns[5:], shift[5:], None), points[5:]),
        ]
        np.savez(tmp_path / "tshirt.npz", **pack.garment_arrays(stick_body, garment, clips, step=2e-4, fps=30.0))
        motion = garments.load(garment="tshirt", path=str(tmp_path), weights="nearest")
        assert np.abs(motion.points - points).max() < 1.05e-4
        assert motion.clip_names == ("a", "b")
        # a cloth of one vertex a joint follows its skeleton exactly: the rig is right if skinning gives the points
        rig = motion.rig
        transforms = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
        placed = kinematics.joint_positions(transforms, rig.joints)
        np.testing.assert_allclose(placed, points, atol=2e-4)
        again = garments.read_poses(tmp_path / "tshirt.npz")
        assert geodesic(again.rotations, poses.rotations).max() < 1e-3


class TestWeights:
    @pytest.fixture
    def ball(self):
        body = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
        share = (body.vertices[:, 1] + 1) / 2
        return body.vertices, body.faces, np.stack([share, 1 - share], 1)

    def test_a_close_cloth_takes_what_lies_under_it(self, ball):
        vertices, faces, weights = ball
        cloth = trimesh.creation.icosphere(subdivisions=3, radius=1.04)
        turned = cloth.vertices @ from_rotation_vector(np.array([0.1, 0.2, 0.3])).T
        got = robust_weights(vertices, faces, weights, turned, cloth.faces)
        expected = (turned[:, 1] / 1.04 + 1) / 2
        np.testing.assert_allclose(got[:, 0], expected, atol=0.01)
        np.testing.assert_allclose(got.sum(1), 1)
        flipped = robust_weights(vertices, faces, weights, turned, cloth.faces[:, ::-1])
        np.testing.assert_allclose(flipped, got, atol=1e-9)  # either side of the cloth

    def test_far_cloth_is_filled_in_smoothly(self, ball):
        vertices, faces, weights = ball
        cloth = trimesh.creation.icosphere(subdivisions=3, radius=1.04)
        points = cloth.vertices.copy()
        points[points[:, 0] > 0.6, 0] += 1.0  # a bulge far from the body
        got = robust_weights(vertices, faces, weights, points, cloth.faces)
        bulge = points[:, 0] > 1.6
        assert got.min() >= 0
        np.testing.assert_allclose(got.sum(1), 1)
        assert np.corrcoef(got[bulge, 0], points[bulge, 1])[0, 1] > 0.95  # it goes on as its rim does: up means more
        same = robust_weights(vertices, faces, np.tile([0.3, 0.7], (len(vertices), 1)), points, cloth.faces)
        np.testing.assert_allclose(same, np.tile([0.3, 0.7], (len(points), 1)), atol=1e-6)

    def test_nearest(self, ball):
        vertices, faces, weights = ball
        np.testing.assert_array_equal(nearest_weights(vertices, weights, 1.1 * vertices), weights)
        nowhere = robust_weights(vertices, faces, weights, vertices[:4] + 50, np.array([[0, 1, 2], [1, 2, 3]]))
        np.testing.assert_array_equal(nowhere, nearest_weights(vertices, weights, vertices[:4] + 50))
