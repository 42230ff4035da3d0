"""The store: what goes in comes out, and damage is noticed."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os

import numpy as np
import pytest

from flows.cache import CorruptArtefact, Store, canonical_json, decode, encode, explained
from tasks.errors import InputError
from tasks.values import Animation, Metrics, Motion, Rig, Skinning, same


def motion() -> Motion:
    rng = np.random.default_rng(0)
    rig = Rig(
        ("root", "tip"),
        np.array([-1, 0], np.int32),
        rng.normal(size=(2, 3)).astype(np.float32),
        np.full((5, 2), 0.5, np.float32),
        np.tile(np.eye(3, dtype=np.float32), (4, 2, 1, 1)),
        np.zeros((4, 2, 3), np.float32),
    )
    points = rng.normal(size=(4, 5, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 3, 4]], np.int32)
    return Motion("x", points, faces, np.array([0, 1, 4]), ("a", "bé"), 24.0, "m", points[0], rig)


VALUES = [
    motion(),
    Metrics(("a",), ("mm",), np.array([1.5])),
    Metrics((), (), np.zeros(0)),
    Animation(np.zeros((2, 3, 3), np.float32)),
]


@pytest.mark.parametrize("value", VALUES, ids=lambda v: type(v).__name__)
def test_values_survive_to_the_bit(value):
    assert same(decode(encode(value)), value)
    assert encode(value) == encode(decode(encode(value)))


def test_values_that_cannot_be_stored_are_refused():
    with pytest.raises(TypeError, match="cannot be stored"):
        encode(Metrics(("a",), ("mm",), {"not": "an array"}))


def put(store: Store, key: str = "k") -> object:
    with store.lock("stage", key):
        return store.put("stage", key, {"out": VALUES[1]}, {"seconds": 1.0, "peak_mb": 2.0})


def test_found_only_when_whole(tmp_path):
    store = Store(tmp_path / "store")
    assert store.find("stage", "k") is None
    ref = put(store)
    found = store.find("stage", "k")
    assert found.outputs == ref.outputs
    assert found.cached
    assert same(store.load(found, "out"), VALUES[1])


def test_truncated_artefact_is_not_a_hit(tmp_path):
    store = Store(tmp_path)
    put(store)
    file = tmp_path / "stage" / "k" / "out.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    assert store.find("stage", "k") is None
    put(store)
    assert same(store.load(store.find("stage", "k"), "out"), VALUES[1])


def test_flipped_bit_is_noticed_on_load(tmp_path):
    store = Store(tmp_path)
    ref = put(store)
    file = tmp_path / "stage" / "k" / "out.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))
    assert store.find("stage", "k") is not None  # the size is right
    with pytest.raises(CorruptArtefact):
        store.load(ref, "out")


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"outputs": {"out": {}}}', '{"outputs": 3}'])
def test_broken_meta_is_not_a_hit(tmp_path, text):
    store = Store(tmp_path)
    put(store)
    (tmp_path / "stage" / "k" / "meta.json").write_text(text)
    assert store.find("stage", "k") is None


def test_leftovers_of_a_crash_are_replaced(tmp_path):
    store = Store(tmp_path)
    draft = tmp_path / "stage" / "k.tmp"
    draft.mkdir(parents=True)
    (draft / "half").write_bytes(b"x")
    put(store)
    assert not draft.exists()
    assert store.find("stage", "k")


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "full disk"), (errno.EROFS, "read-only"), (errno.EACCES, "no permission")],
)
def test_unusable_disk_is_one_line(tmp_path, number, words):
    with pytest.raises(InputError, match=words), explained(tmp_path):
        raise OSError(number, os.strerror(number))


def test_a_file_in_the_stores_place(tmp_path):
    (tmp_path / "store").write_text("")
    with pytest.raises(InputError, match="a file in its place"):
        Store(tmp_path / "store")


def _race(path: str, queue) -> None:
    store = Store(path)
    with store.lock("stage", "k"):
        found = store.find("stage", "k")
        if not found:
            put_locked = store.put("stage", "k", {"out": VALUES[1]}, {"seconds": 0.0, "peak_mb": 0.0})
            queue.put("wrote" if put_locked else "")
        else:
            queue.put("found")


def test_of_several_writers_one_writes(tmp_path):
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    workers = [context.Process(target=_race, args=(str(tmp_path), queue)) for _ in range(3)]
    for worker in workers:
        worker.start()
    said = sorted(queue.get(timeout=60) for _ in workers)
    for worker in workers:
        worker.join(60)
    assert said == ["found", "found", "wrote"]


def test_canonical_json_does_not_depend_on_order():
    assert canonical_json({"b": 1, "a": [1.5]}) == canonical_json(json.loads('{"a": [1.5], "b": 1}'))
    with pytest.raises(ValueError):
        canonical_json(float("nan"))


def test_skinning_round_trip_keeps_types():
    value = Skinning(*(np.ones(s, np.float32) for s in ((2, 3), (2, 1), (1, 1, 3, 4))), np.ones(2))
    back = decode(encode(value))
    assert back.history.dtype == np.float64
    assert back.rest.dtype == np.float32
