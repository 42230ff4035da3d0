"""Captures on disk: layouts written and read, conventions, images of every kind, and what is refused."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tasks.captures import cameras as cam
from tasks.captures import dnerf, files, multiview, validate
from tasks.captures.scenes import render_scene
from tasks.errors import InputError
from tests.analytic.test_scenes import SCENE, ball

DNERF = {"size": None, "background": "none", "up": "z", "fps": 30.0, "unit": "unit"}
MULTIVIEW = {"size": None, "background": "none"}


@pytest.fixture(scope="module")
def monocular():
    return render_scene(ball(), **SCENE)


@pytest.fixture(scope="module")
def ring():
    return render_scene(ball(rig=True), **SCENE | {"layout": "multiview", "size": 32})


@pytest.fixture
def scene(tmp_path, monocular):
    dnerf.write_dnerf(*monocular, tmp_path)
    return tmp_path


def load(folder, **change):
    return dnerf.load(path=str(folder), **DNERF | change)


def edit(folder, change, split="train"):
    """Applies a change to the parsed transforms file."""
    file = folder / f"transforms_{split}.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def refused(call, *words):
    with pytest.raises(InputError) as error:
        call()
    text = str(error.value)
    assert "\n" not in text
    for word in words:
        assert word in text


def test_what_is_written_in_the_layout_of_dnerf_is_read_again(scene, monocular):
    for before, after in zip(monocular, load(scene), strict=True):
        assert np.array_equal(after.images, before.images)
        np.testing.assert_allclose(after.view, before.view, atol=1e-5)
        np.testing.assert_allclose(after.intrinsics, before.intrinsics, rtol=1e-6)
        np.testing.assert_allclose(after.times[after.frame], before.times[before.frame], atol=1e-6)
        assert np.array_equal(after.frame, before.frame)
        assert (after.has_alpha, after.fps) == (True, 24.0)
        assert len(np.unique(after.camera)) == len(after.camera)
    validation = json.loads((scene / "transforms_val.json").read_text())
    assert len(validation["frames"]) == SCENE["test_views"]


def handmade(folder, **top):
    """Two views of a world whose up is +Z, one from -y with the identity's camera turned upright, one from +x."""
    front = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]  # right = x, up = z, backward = -y
    side = [[0, 0, 1, 4], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]  # right = y, up = z, backward = x
    for split in ("train", "test"):
        (folder / split).mkdir()
        frames = []
        for i, matrix in enumerate((front, side)):
            image = np.zeros((60, 80, 4), np.uint8)
            image[20:40, 30:50] = (255, 0, 0, 255)
            (folder / split / f"r_{i}.png").write_bytes(files.png(image))
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix})
        content = {"camera_angle_x": float(2 * np.arctan(0.5)), "frames": frames} | top
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))


def test_conventions_of_a_file_written_by_hand(tmp_path):
    """A point one up (+Z there, +Y here) and a point one to the right (+x), seen from the front and from the side."""
    handmade(tmp_path)
    train, _ = load(tmp_path)
    assert train.intrinsics[0, 0, 0] == pytest.approx(80)  # 40 / tan(angle / 2)
    np.testing.assert_allclose(cam.eyes(train.view), [[0, 0, 4], [4, 0, 0]], atol=1e-6)
    up, right = np.array([[0.0, 1, 0]]), np.array([[1.0, 0, 0]])
    front, side = zip(train.view, train.intrinsics, strict=True)
    np.testing.assert_allclose(cam.project(up, *front), [[40, 30 - 20]], atol=1e-4)
    np.testing.assert_allclose(cam.project(right, *front), [[40 + 20, 30]], atol=1e-4)
    np.testing.assert_allclose(cam.project(right, *side), [[40, 30]], atol=1e-4)
    np.testing.assert_allclose(cam.project(np.array([[0, 0, 1.0]]), *side), [[40 - 20, 30]], atol=1e-4)
    assert train.frame.tolist() == [0, 1]
    np.testing.assert_allclose(train.times, [0, 0.5])  # index over number
    y_up, _ = load(tmp_path, up="y")
    np.testing.assert_allclose(cam.eyes(y_up.view), [[0, -4, 0], [4, 0, 0]], atol=1e-6)


def test_focal_lengths_may_stand_for_the_angle(tmp_path):
    handmade(tmp_path, fl_x=70.0, fl_y=75.0, cx=41.0, cy=29.0)
    np.testing.assert_allclose(load(tmp_path)[0].intrinsics[1], [[70, 0, 41], [0, 75, 29], [0, 0, 1]])


def test_images_are_brought_down_with_their_intrinsics_and_without_dark_rims(tmp_path):
    handmade(tmp_path)
    train, _ = load(tmp_path, size=20)
    assert train.images.shape[1:] == (15, 20, 4)
    np.testing.assert_allclose(train.intrinsics[0], [[20, 0, 10], [0, 20, 7.5], [0, 0, 1]])
    part = (train.images[0, ..., 3] > 0) & (train.images[0, ..., 3] < 255)
    assert part.any()
    assert (train.images[0][part][:, 0] == 255).all()


def test_images_smaller_than_the_size_asked_for_stay_as_they_are(tmp_path):
    handmade(tmp_path)
    asked, own = load(tmp_path, size=200)[0], load(tmp_path, size=None)[0]
    assert asked.images.shape[1:3] == (60, 80)
    assert np.array_equal(asked.images, own.images)
    assert np.array_equal(asked.intrinsics, own.intrinsics)


def test_times_of_both_halves_are_one_list(scene):
    edit(scene, lambda c: c["frames"][1].update(time=0.123), "test")
    train, test = load(scene)
    assert np.array_equal(train.times, test.times)
    assert np.float32(0.123) in test.times
    assert train.times[train.frame].max() == 1


CHANGES = {
    "time out of range": (lambda c: c["frames"][3].update(time=1.5), ["time", "1.5", "image 3"]),
    "time not a number": (lambda c: c["frames"][3].update(time="late"), ["time", "numbers"]),
    "no angle": (lambda c: c.pop("camera_angle_x"), ["camera_angle_x"]),
    "an angle in degrees": (lambda c: c.update(camera_angle_x=40), ["camera_angle_x in radians", "= 40"]),
    "a focal length in shares": (lambda c: c.update(fl_x=1.2), ["intrinsics of image 0", "in pixels"]),
    "a rate in words": (lambda c: c.update(fps="fast"), ["fps", "'fast'"]),
    "a file elsewhere": (lambda c: c["frames"][5].update(file_path="/nowhere/r_5"), ["no /nowhere/r_5.png", "1 of"]),
    "a name too long": (lambda c: c["frames"][5].update(file_path="x" * 999), ["xxx", "1 of 12"]),
    "negative angle": (lambda c: c.update(camera_angle_x=-1), ["camera_angle_x = -1"]),
    "no frames": (lambda c: c.update(frames=[]), ["frames", "list of images"]),
    "no matrix": (lambda c: c["frames"][2].pop("transform_matrix"), ["frames[2].transform_matrix", "4 x 4"]),
    "ragged matrix": (lambda c: c["frames"][2].update(transform_matrix=[[1], [2, 3]]), ["frames[2]", "4 x 4"]),
    "missing file": (lambda c: c["frames"][5].update(file_path="./train/none"), ["train/none.png", "1 of 12"]),
    "scaled cameras": (
        lambda c: [f.update(transform_matrix=(2 * np.array(f["transform_matrix"])).tolist()) for f in c["frames"]],
        ["camera of image 0", "rotation"],
    ),
    "turned cameras": (
        lambda c: [
            f.update(transform_matrix=(np.array(f["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])).tolist())
            for f in c["frames"]
        ],
        ["cameras", "look away", "convention"],
    ),
    "another unit": (
        lambda c: [
            f.update(
                transform_matrix=(
                    np.diag([0.1, 0.1, 0.1, 1]) @ np.array(f["transform_matrix"]) @ np.diag([10.0, 10, 10, 1])
                ).tolist()
            )
            for f in c["frames"][:1]
        ],
        ["camera of image 0", "outside the subject"],
    ),
    "a camera that stands still": (
        lambda c: [f.update(transform_matrix=c["frames"][0]["transform_matrix"]) for f in c["frames"]],
        ["stands still", "ill-posed"],
    ),
}


@pytest.mark.parametrize("case", CHANGES)
def test_a_fault_in_the_transforms_is_one_line(scene, case):
    change, words = CHANGES[case]
    edit(scene, change)
    refused(lambda: load(scene), *words)


def test_missing_and_damaged_files_are_one_line(tmp_path, scene):
    refused(lambda: load(tmp_path / "nowhere"), "transforms_train.json", "no such folder")
    (scene / "transforms_train.json").write_text("{")
    refused(lambda: load(scene), "transforms_train.json", "JSON")
    (scene / "transforms_train.json").unlink()
    refused(lambda: load(scene), "transforms_train.json", "none")


def test_images_of_another_size_or_without_alpha_are_one_line(scene, monocular):
    image = monocular[0].images[4]
    (scene / "train" / "r_004.png").write_bytes(files.png(image[:-1]))
    refused(lambda: load(scene), "r_004.png", "48 x 47", "48 x 48")
    cv2.imwrite(str(scene / "train" / "r_004.png"), image[..., :3])
    refused(lambda: load(scene), "alpha", "r_004.png")


def test_without_alpha_the_background_must_be_said(scene, monocular):
    for split in ("train", "test"):
        for file in (scene / split).iterdir():
            cv2.imwrite(str(file), cv2.imread(str(file))[..., :3])
    refused(lambda: load(scene), "no alpha and no background given", "dataset.background")
    train, _ = load(scene, background="black")
    assert not train.has_alpha
    assert (train.images[..., 3] == 255).all()
    assert train.background.tolist() == [0, 0, 0]
    assert validate.notes(train)[0].startswith("no alpha")


def test_inverted_masks_and_wrong_times_are_named(monocular):
    train = monocular[0]
    flipped = train.images.copy()
    flipped[..., 3] = 255 - flipped[..., 3]
    refused(lambda: validate.check("x", replace(train, images=flipped), training=True), "alpha", "invert")
    same_times = replace(train, times=np.zeros(6, np.float32))
    refused(lambda: validate.check("x", same_times, training=True), "time", "rising")
    refused(lambda: validate.check("x", train.take(np.zeros(0, int)), training=True), "images", "none")
    beyond = replace(train, frame=train.frame + 1)
    refused(lambda: validate.check("x", beyond, training=True), "frame", "0 to 5")


def test_oddities_are_noted(monocular):
    train = monocular[0]
    assert validate.notes(train) == []
    times = train.times.copy()
    times[3] = times[2] + 1e-4
    images = train.images.copy()
    images[2] = 0
    found = validate.notes(replace(train, times=times, images=images).take(np.arange(9)))
    assert len(found) == 2
    assert "1 of 9 images show nothing" in found[0]
    assert "nearly equal" in found[1]


def test_a_monocular_test_camera_may_stand_still(monocular):
    still = replace(monocular[1], view=np.repeat(monocular[1].view[:1], 4, 0))
    assert validate.check("x", still, training=False) is still


# images


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(depth: int, colour: int, row: bytes, *extra: bytes) -> bytes:
    """A PNG of two pixels."""
    head = struct.pack(">IIBBBBB", 2, 1, depth, colour, 0, 0, 0)
    body = [chunk(b"IHDR", head), *extra, chunk(b"IDAT", zlib.compress(b"\0" + row)), chunk(b"IEND", b"")]
    return files.PNG + b"".join(body)


PALETTE = chunk(b"PLTE", bytes([1, 2, 3, 200, 100, 50]))
KINDS = {
    "rgb": (png(8, 2, bytes([1, 2, 3, 200, 100, 50])), [[1, 2, 3, 255], [200, 100, 50, 255]], False),
    "rgba": (png(8, 6, bytes([1, 2, 3, 4, 5, 6, 7, 8])), [[1, 2, 3, 4], [5, 6, 7, 8]], True),
    "grey": (png(8, 0, bytes([9, 200])), [[9, 9, 9, 255], [200, 200, 200, 255]], False),
    "one bit": (png(1, 0, bytes([0b01000000])), [[0, 0, 0, 255], [255, 255, 255, 255]], False),
    "grey, alpha": (png(8, 4, bytes([9, 20, 200, 255])), [[9, 9, 9, 20], [200, 200, 200, 255]], True),
    "16 bits": (
        png(16, 2, struct.pack(">6H", 0, 257, 514, 65535, 300, 128)),
        [[0, 1, 2, 255], [255, 1, 0, 255]],
        False,
    ),
    "palette": (png(8, 3, bytes([0, 1]), PALETTE), [[1, 2, 3, 255], [200, 100, 50, 255]], False),
    "palette, clear": (
        png(8, 3, bytes([0, 1]), PALETTE, chunk(b"tRNS", bytes([0, 99]))),
        [[1, 2, 3, 0], [200, 100, 50, 99]],
        True,
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_png_becomes_rgba(tmp_path, kind):
    data, pixels, alpha = KINDS[kind]
    (tmp_path / "a.png").write_bytes(data)
    image, found = files.read_image(tmp_path / "a.png")
    assert image.tolist() == [pixels]
    assert found == alpha


def test_jpegs_are_read_and_truncated_ones_are_not(tmp_path):
    data = cv2.imencode(".jpg", np.full((20, 20, 3), (10, 100, 200), np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(data)
    image, alpha = files.read_image(tmp_path / "a.jpg")
    assert not alpha
    np.testing.assert_allclose(image[5, 5], [200, 100, 10, 255], atol=3)
    (tmp_path / "a.jpg").write_bytes(data[:-40])
    refused(lambda: files.read_image(tmp_path / "a.jpg"), "a.jpg", "truncated JPEG")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95, 0.999])
def test_truncated_pngs_are_one_line(scene, share):
    file = scene / "train" / "r_007.png"
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    refused(lambda: load(scene), "r_007.png", "truncated")


def test_other_files_are_one_line(tmp_path):
    data = KINDS["rgb"][0]
    cases = {b"": "empty", b"hello, this is text": "something else", data[:50] + b"x" + data[51:]: "damaged"}
    for content, word in cases.items():
        (tmp_path / "a.png").write_bytes(content)
        refused(lambda: files.read_image(tmp_path / "a.png"), "a.png", word)


# several cameras


def test_what_is_written_by_several_cameras_is_read_again(tmp_path, ring):
    multiview.write_multiview(*ring, tmp_path)
    for before, after in zip(ring, multiview.load(path=str(tmp_path), **MULTIVIEW), strict=True):
        order = np.lexsort((before.frame, before.camera))
        assert np.array_equal(after.images, before.images[order])
        assert np.array_equal(after.view, before.view[order])
        np.testing.assert_allclose(after.intrinsics, before.intrinsics[order], rtol=1e-6)
        assert np.array_equal(after.frame, before.frame[order])
        assert (after.clip_start.tolist(), after.clip_names, after.fps) == ([0, 3, 6], ("one", "two"), 24.0)
        assert after.rig.weights.shape == (0, 1)
        np.testing.assert_allclose(after.rig.rotations, before.rig.rotations, atol=1e-6)


def test_masks_and_rotation_vectors_as_other_captures_have_them(tmp_path, ring):
    multiview.write_multiview(*ring, tmp_path)
    for file in sorted((tmp_path / "frames").rglob("*.png")):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        mask = tmp_path / "masks" / file.parent.name / file.name
        mask.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(mask), image[..., 3])
        cv2.imwrite(str(file), image[..., :3])
    vectors = np.outer(np.linspace(0, 1, 6), [0.0, 0.0, 1.0])[:, None]
    rig = {"names": ["root"], "parents": [-1], "joints": np.zeros((1, 3)), "root": np.zeros((6, 3))}
    np.savez(tmp_path / "skeleton.npz", rotations=vectors, **rig)
    train, _ = multiview.load(path=str(tmp_path), **MULTIVIEW)
    assert train.has_alpha
    np.testing.assert_allclose(train.rig.rotations, ring[0].rig.rotations, atol=1e-6)
    order = np.lexsort((ring[0].frame, ring[0].camera))
    assert np.array_equal(train.images[..., 3], ring[0].images[order][..., 3])
    (tmp_path / "masks" / "train02" / "000003.png").unlink()
    refused(lambda: multiview.load(path=str(tmp_path), **MULTIVIEW), "masks", "train02", "frame 3")


FAULTS = {
    "no fps": (lambda c: c.pop("fps"), ["fps"]),
    "unknown unit": (lambda c: c.update(unit="mm"), ["unit", "'mm'"]),
    "no cameras": (lambda c: c.update(cameras=[]), ["cameras", "list"]),
    "twice the name": (lambda c: c["cameras"][1].update(name="train00"), ["cameras[1].name", "train00"]),
    "split": (lambda c: c["cameras"][1].update(split="val"), ["cameras[1].split", "'val'"]),
    "short matrix": (lambda c: c["cameras"][1].update(world_to_camera=[1, 2]), ["world_to_camera", "4 x 4"]),
    "no test camera": (lambda c: [k.update(split="train") for k in c["cameras"]], ["split is test"]),
    "clips": (lambda c: c.update(clips=[{"name": "a", "start": 3}]), ["clips", "from 0"]),
    "no folder": (lambda c: c["cameras"][1].update(name="elsewhere"), ["elsewhere", "no such folder"]),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_fault_in_the_cameras_is_one_line(tmp_path, ring, case):
    change, words = FAULTS[case]
    multiview.write_multiview(*ring, tmp_path)
    file = tmp_path / "cameras.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    refused(lambda: multiview.load(path=str(tmp_path), **MULTIVIEW), *words)


def test_missing_frames_and_bad_skeletons_are_one_line(tmp_path, ring):
    multiview.write_multiview(*ring, tmp_path)
    np.savez(tmp_path / "skeleton.npz", names=np.array(["a"]))
    refused(lambda: multiview.load(path=str(tmp_path), **MULTIVIEW), "skeleton.npz", "parents")
    rig = {"names": np.array(["a"]), "parents": np.array([-1]), "joints": np.zeros((1, 3)), "root": np.zeros((6, 3))}
    for turns in (np.zeros((6, 1, 2)), np.full((6, 1, 3), "x"), np.zeros((5, 1, 3)), np.zeros((6, 1, 3, 3))):
        np.savez(tmp_path / "skeleton.npz", **rig, rotations=turns)
        refused(lambda: multiview.load(path=str(tmp_path), **MULTIVIEW), "skeleton.npz: rotations")
    np.savez(tmp_path / "skeleton.npz", **rig | {"names": np.array("a")}, rotations=np.zeros((6, 1, 3)))
    assert multiview.load(path=str(tmp_path), **MULTIVIEW)[0].rig.names == ("a",)
    (tmp_path / "skeleton.npz").write_bytes(b"nothing")
    refused(lambda: multiview.load(path=str(tmp_path), **MULTIVIEW), "skeleton.npz")
    (tmp_path / "skeleton.npz").unlink()
    (tmp_path / "frames" / "train01" / "000002.png").unlink()
    refused(lambda: multiview.load(path=str(tmp_path), **MULTIVIEW), "train01", "no frame 2")


def test_masks_that_show_nothing_are_one_line(scene):
    for file in (scene / "train").iterdir():
        file.write_bytes(files.png(0 * files.read_image(file)[0]))
    refused(lambda: load(scene), "alpha", "none that shows anything")


def test_json_as_windows_writes_it_and_json_without_end(tmp_path):
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf{}")
    assert files.read_json(tmp_path / "a.json") == {}
    (tmp_path / "a.json").write_text("[" * 100_000)
    refused(lambda: files.read_json(tmp_path / "a.json"), "a.json", "JSON")


def test_layouts_refuse_what_they_cannot_hold(tmp_path, monocular, ring):
    refused(lambda: multiview.write_multiview(*monocular, tmp_path), "every frame", "write_dnerf")
    wide = ring[0].intrinsics.copy()
    wide[0, 0, 0] *= 2
    refused(lambda: dnerf.write_dnerf(replace(ring[0], intrinsics=wide), ring[1], tmp_path), "centred")
