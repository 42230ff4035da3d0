"""Every kind of bad mesh sequence ends in one line that names the file, the field and what was found."""

from __future__ import annotations

import os
import zipfile

import numpy as np
import pytest

from tasks.datasets import mesh_sequence, validate
from tasks.errors import InputError
from tasks.values import About

FRAMES, POINTS = 5, 8
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
_SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([t for a, b, c, d in _SIDES for t in ((a, b, c), (a, c, d))], np.int32)


def moving_cube() -> np.ndarray:
    shift = np.zeros((FRAMES, 1, 3), np.float32)
    shift[:, 0, 0] = np.arange(FRAMES)
    return CUBE + shift


def load(path, **changed):
    return mesh_sequence.load(**{"path": str(path), "fps": 24.0, "faces": True, "unit": "unit"} | changed)


def write(path, **changed):
    arrays = {"vertices": moving_cube(), "faces": FACES} | changed
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    return path


def rejects(call, *says: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in says), message


def test_a_good_file_loads(tmp_path):
    motion = load(write(tmp_path / "cube.npz", clip_start=[0, 2, 5], clip_names=["a", "b"], fps=30.0))
    assert (motion.name, motion.fps, motion.clip_names) == ("cube", 30.0, ("a", "b"))
    assert motion.points.dtype == np.float32
    assert motion.faces.dtype == np.int32
    np.testing.assert_array_equal(motion.points, moving_cube())


def test_bare_points_on_request(tmp_path):
    path = write(tmp_path / "points.npz", faces=None)
    assert load(path, faces=False).faces is None
    rejects(lambda: load(path), "points.npz", "faces")


def broken(where: tuple, value: float) -> np.ndarray:
    vertices = moving_cube()
    vertices[where] = value
    return vertices


BAD_ARRAYS = {
    "nan": ({"vertices": broken((3, 6, 1), np.nan)}, ("vertices", "frame 3", "vertex 6", "nan")),
    "infinite": ({"vertices": broken((2, 0, 0), np.inf)}, ("vertices", "frame 2", "vertex 0", "inf")),
    "too large for float32": ({"vertices": moving_cube() * np.float64(1e60)}, ("vertices", "finite")),
    "no vertices key": ({"vertices": None}, ("vertices",)),
    "no faces key": ({"faces": None}, ("add faces",)),
    "one frame": ({"vertices": moving_cube()[:1]}, ("2 frames", "found 1")),
    "no frame": ({"vertices": moving_cube()[:0]}, ("2 frames", "found 0")),
    "no point": ({"vertices": moving_cube()[:, :0]}, ("4 points", "found 0")),
    "one shape": ({"vertices": CUBE}, ("(frames, points, 3)", "(8, 3)")),
    "flat points": ({"vertices": moving_cube()[..., :2]}, ("(frames, points, 3)", "(5, 8, 2)")),
    "text": ({"vertices": np.full((5, 8, 3), "1.0")}, ("real numbers", "<U3")),
    "complex": ({"vertices": moving_cube() * 1j}, ("real numbers", "complex")),
    "pickled": ({"vertices": np.array([CUBE, None], dtype=object)}, ("vertices", "pickled", "never loaded")),
    "far from the origin": ({"vertices": moving_cube() + 1e6}, ("origin", "1e+06", "subtract the centre")),
    "walks far from the origin": (
        {"vertices": moving_cube() + np.arange(5.0)[:, None, None] * 1e6},
        ("origin", "4e+06 at frame 4", "a path that leads so far"),
    ),
    "too small": ({"vertices": moving_cube() * np.float32(1e-7)}, ("1e-05 to 1e+09 units", "scale all coordinates")),
    "too large": ({"vertices": moving_cube() * np.float32(1e12)}, ("1e-05 to 1e+09 units", "scale all coordinates")),
    "still": ({"vertices": np.repeat(CUBE[None], 5, 0)}, ("moving", "5 frames")),
    "all in one place": ({"vertices": np.zeros((5, 8, 3)) + np.arange(5)[:, None, None]}, ("one place",)),
    "face out of range": ({"faces": np.vstack([FACES, [[0, 1, 8]]])}, ("0 to 7", "[0, 1, 8]", "face 12")),
    "faces from 1": ({"faces": FACES + 1}, ("0 to 7", "subtract 1")),
    "negative face": ({"faces": FACES - 1}, ("0 to 7", "-1")),
    "quads": ({"faces": np.array([[0, 1, 3, 2]])}, ("triangles", "triangulate")),
    "no faces in it": ({"faces": FACES[:0]}, ("at least one triangle", "dataset.faces=false")),
    "faces of floats": ({"faces": FACES.astype(float)}, ("whole numbers", "float64")),
    "clips that miss frames": ({"clip_start": [0, 2, 4]}, ("clip_start", "0 to 5", "[0, 2, 4]")),
    "an empty clip": ({"clip_start": [0, 2, 2, 5]}, ("clip_start", "rising")),
    "too few clip names": ({"clip_start": [0, 2, 5], "clip_names": ["a"]}, ("clip_names", "2 names")),
    "clip names twice": ({"clip_start": [0, 2, 5], "clip_names": ["a", "a"]}, ("clip_names", "a more than once")),
    "clip names of numbers": ({"clip_start": [0, 2, 5], "clip_names": [1, 2]}, ("clip_names", "strings")),
    "no rate": ({"fps": 0.0}, ("fps", "above zero")),
    "several rates": ({"fps": [24.0, 25.0]}, ("fps", "one number")),
}


@pytest.mark.parametrize("name", BAD_ARRAYS)
def test_bad_arrays(tmp_path, name):
    changed, says = BAD_ARRAYS[name]
    path = write(tmp_path / "cube.npz", **changed)
    rejects(lambda: load(path), str(path), *says)


def test_pickles_are_not_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the file was unpickled",))

    path = tmp_path / "trap.npz"
    np.savez(path, vertices=np.array([Trap()], dtype=object), faces=FACES)
    rejects(lambda: load(path), "pickled")
    path.write_bytes(b"\x80\x04K\x01.")  # a bare pickle under that name
    rejects(lambda: load(path), "something else")


def test_paths(tmp_path):
    rejects(lambda: load(""), "dataset.path", "empty path")
    rejects(lambda: load(tmp_path / "none.npz"), "none.npz", "no such file")
    rejects(lambda: load(tmp_path / "no" / "none.npz"), "none.npz", "no folder")
    rejects(lambda: load(tmp_path), "an empty folder")
    (tmp_path / "notes.txt").write_text("hello")
    rejects(lambda: load(tmp_path), ".txt")
    rejects(lambda: load(tmp_path / "notes.txt"), "something else")
    (tmp_path / "one.obj").write_text("v 0 0 0")
    rejects(lambda: load(tmp_path / "one.obj"), "a single mesh")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.npz")
        rejects(lambda: load(tmp_path / "pipe.npz"), "neither a file nor a folder")


def test_damaged_npz(tmp_path):
    whole = write(tmp_path / "cube.npz").read_bytes()
    path = tmp_path / "part.npz"
    path.write_bytes(b"")
    rejects(lambda: load(path), "part.npz", "an empty file")
    path.write_bytes(whole[: len(whole) // 2])
    rejects(lambda: load(path), "part.npz", "truncated")
    data = bytearray(whole)
    data[200] ^= 0xFF  # inside the first array: the zip checksum no longer fits
    path.write_bytes(data)
    rejects(lambda: load(path), "part.npz: vertices", "damaged")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vertices.npy", b"not an array")
        archive.writestr("faces.npy", b"")
    rejects(lambda: load(path), "part.npz: vertices")
    with zipfile.ZipFile(path, "w"):
        pass
    rejects(lambda: load(path), "no keys")


def obj(vertices: np.ndarray, faces: np.ndarray) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + ["vn 0 0 1"]
    return "\n".join(["# made for a test", *lines, *(f"f {a}//1 {b}//1 {c}//1" for a, b, c in faces + 1)]) + "\n"


@pytest.fixture
def frames(tmp_path):
    """A folder of OBJ files whose order by text differs from that by number."""
    folder = tmp_path / "walk"
    folder.mkdir()
    for k, vertices in enumerate(moving_cube()):
        (folder / f"frame{8 + k}.obj").write_text(obj(vertices, FACES))
    (folder / ".hidden.obj").write_text("nothing")
    (folder / "walk.mtl").write_text("newmtl skin")
    return folder


def test_folder_of_frames_in_natural_order(frames):
    motion = load(frames)
    assert motion.name == "walk"
    np.testing.assert_array_equal(motion.points, moving_cube())
    np.testing.assert_array_equal(motion.faces, FACES)


def test_folder_of_clips(frames, tmp_path):
    second = tmp_path / "run"
    second.mkdir()
    for k in (8, 9):
        (second / f"{k}.obj").write_text((frames / f"frame{k}.obj").read_text())
    (tmp_path / "textures").mkdir()
    motion = load(tmp_path)
    assert motion.clip_names == ("run", "walk")
    assert motion.clip_start.tolist() == [0, 2, 7]
    (tmp_path / "stray.obj").write_text("v 0 0 0")
    rejects(lambda: load(tmp_path), "1 mesh files beside 2 folders")


def test_folder_of_ply(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    for k, vertices in enumerate(moving_cube()):
        trimesh.Trimesh(vertices, FACES, process=False).export(tmp_path / f"{k}.ply")
    motion = load(tmp_path)
    np.testing.assert_array_equal(motion.points, moving_cube())
    np.testing.assert_array_equal(motion.faces, FACES)
    whole = (tmp_path / "3.ply").read_bytes()
    (tmp_path / "3.ply").write_bytes(whole[: len(whole) // 2])
    rejects(lambda: load(tmp_path), "3.ply")
    (tmp_path / "3.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    rejects(lambda: load(tmp_path), "3.ply", "no vertices")
    (tmp_path / "3.obj").write_text("v 0 0 0")
    rejects(lambda: load(tmp_path), "both .obj and .ply")


def test_polygons_become_fans(tmp_path):
    for k, vertices in enumerate(moving_cube()):
        text = obj(vertices, FACES[:0]) + "f 1 2 4 3\nf 5/1/1 6/1/1 8/1/1\n"
        (tmp_path / f"{k}.obj").write_text(text)
    assert load(tmp_path).faces.tolist() == [[0, 1, 3], [0, 3, 2], [4, 5, 7]]


def test_texts_that_programs_write_differently(tmp_path):
    """The mark of Windows editors before the first vertex, their line ends, colours behind, remarks."""
    for k, vertices in enumerate(moving_cube()):
        lines = [f"v {x} {y} {z} 0.5 0.5 0.5" for x, y, z in vertices]
        lines += [f"f {a} {b} {c} # remark" for a, b, c in FACES + 1]
        (tmp_path / f"{k}.obj").write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    motion = load(tmp_path)
    np.testing.assert_array_equal(motion.points, moving_cube())
    np.testing.assert_array_equal(motion.faces, FACES)


def test_topology_that_changes(frames):
    last = frames / "frame12.obj"
    good = last.read_text()
    last.write_text(obj(moving_cube()[4], FACES[::-1]))
    rejects(lambda: load(frames), "frame12.obj: faces", "frame8.obj")
    last.write_text(good.replace("//1", "//7"))  # other normals are no other topology
    assert load(frames).frames == FRAMES
    last.write_text(obj(moving_cube()[4], FACES[::-1]))
    assert load(frames, faces=False).frames == FRAMES
    last.write_text("v 0 0 0\n" + good)
    rejects(lambda: load(frames), "frame12.obj: vertices", "expected 8", "found 9")
    last.write_text("")
    rejects(lambda: load(frames), "frame12.obj", "empty file")
    last.write_text("# nothing\n")
    rejects(lambda: load(frames), "frame12.obj", "no vertices")
    last.write_text(good.replace("v 4.0 0.0 0.0", "v 4.0 zero 0.0"))
    rejects(lambda: load(frames), "frame12.obj: v", "v 4.0 zero 0.0")
    last.write_text(good.replace("v 4.0 0.0 0.0", "v 4.0 0.0"))
    rejects(lambda: load(frames), "frame12.obj: v", "v 4.0 0.0")
    last.write_text(good.replace("v 4.0 0.0 0.0", "v 4.0 nan 0.0"))
    rejects(lambda: load(frames), "frame 4, vertex 0")


@pytest.mark.parametrize("line", ["f 1 2", "f a b c", "f -1 -2 -3", "f 1 2 99999999999999999999", "f 1 2 # 3"])
def test_faces_that_are_none(tmp_path, line):
    for k, vertices in enumerate(moving_cube()):
        (tmp_path / f"{k}.obj").write_text(obj(vertices, FACES[:1]) + line + "\n")
    rejects(lambda: load(tmp_path), "0.obj: f")


def test_odd_meshes_are_accepted_and_noted(tmp_path):
    vertices = np.concatenate([moving_cube(), moving_cube() + 3, moving_cube()[:, :1]], axis=1)
    faces = np.concatenate([FACES, FACES[:-1] + POINTS, [[0, 0, 1]]])
    notes = validate.notes(load(write(tmp_path / "odd.npz", vertices=vertices, faces=faces)))
    for words in ("2 separate components", "1 points are on no face", "boundary edges", "1 faces without area"):
        assert any(words in note for note in notes), (words, notes)
    assert any("1 of 17 points lie exactly on another" in note for note in notes)
    assert validate.notes(load(write(tmp_path / "cube.npz"))) == []
    assert validate.about(load(tmp_path / "odd.npz")) == About("odd", tuple(notes))


def test_a_clip_that_does_not_move_is_noted(tmp_path):
    vertices = np.concatenate([moving_cube(), np.repeat(CUBE[None], 4, 0)])
    motion = load(write(tmp_path / "cube.npz", vertices=vertices, clip_start=[0, 5, 9], clip_names=["go", "stay"]))
    assert validate.notes(motion) == ["clips that do not move: stay"]
