"""Files of captures: images as (H, W, 4) uint8, JSON. What can be converted safely is, the rest is one clear line."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from tasks.errors import InputError

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
EXPECTED = "a PNG or JPEG image"


def read_image(path: Path) -> tuple[np.ndarray, bool]:
    """An image as RGBA, not multiplied by alpha, and whether the file brings alpha (it is 255 where not).

    Grey becomes RGB, 16 bits become 8, a palette is looked up, its transparent colours included. Raises InputError for
    a file that is missing, empty, truncated, damaged or no PNG or JPEG.
    """
    image = _decode(path)
    if image.ndim == 2:
        image = np.repeat(image[:, :, None], 3, 2)
    image = np.concatenate([image[:, :, 2::-1], image[:, :, 3:]], 2)  # OpenCV's order is blue, green, red
    alpha = image.shape[2] == 4
    if not alpha:
        image = np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], 2)
    return np.ascontiguousarray(image), alpha


def read_mask(path: Path) -> np.ndarray:
    """A mask (H, W) uint8: alpha where the file has it, else its brightest channel."""
    image, alpha = read_image(path)
    return image[:, :, 3] if alpha else image[:, :, :3].max(2)


def png(image: np.ndarray) -> bytes:
    """RGBA (H, W, 4) or grey (H, W) uint8 as a PNG file."""
    order = image if image.ndim == 2 else image[:, :, [2, 1, 0, 3]]
    return cv2.imencode(".png", order)[1].tobytes()


def write_files(files: dict[str, bytes], folder: Path) -> None:
    """Writes files by their paths below a folder."""
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)


def resize(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """A smaller RGBA image by means over areas; colours count by their alpha. (H, W, 4) -> (height, width, 4) uint8"""
    if image.shape[:2] == (height, width):
        return image
    alpha = image[:, :, 3:].astype(np.float32) / 255
    weighted = np.concatenate([image[:, :, :3] * alpha, alpha], 2)
    small = cv2.resize(weighted, (width, height), interpolation=cv2.INTER_AREA)
    straight = small[:, :, :3] / np.maximum(small[:, :, 3:], 1e-6)
    return np.rint(np.concatenate([straight, 255 * small[:, :, 3:]], 2).clip(0, 255)).astype(np.uint8)


def _decode(path: Path) -> np.ndarray:
    """Pixels as the file has them, in 8 bits, channels in OpenCV's order."""
    if not path.is_file():
        raise InputError(str(path), expected=EXPECTED, found="no such file", do="add it, or leave out its entry")
    data = path.read_bytes()
    if data.startswith(PNG):
        _whole_png(path, data)
    elif data.startswith(JPEG):
        _check(path, data.rstrip(b"\0").endswith(b"\xff\xd9"), "a truncated JPEG")
    else:
        _check(path, False, "an empty file" if not data else "something else")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    _check(path, image is not None, "damaged data")
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    _check(path, image.dtype == np.uint8, f"pixels of {image.dtype}")
    return image


def _whole_png(path: Path, data: bytes) -> None:
    """Walks the chunks: the decoder itself fills what a truncated file lacks and says nothing."""
    at = len(PNG)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 8 + length
        if end + 4 > len(data):
            break
        _check(path, zlib.crc32(data[at + 4 : end]) == int.from_bytes(data[end : end + 4], "big"), "damaged data")
        if kind == b"IEND":
            return
        at = end + 4
    _check(path, False, "a truncated PNG")


def _check(path: Path, ok: bool, found: str) -> None:
    if not ok:
        raise InputError(str(path), expected=EXPECTED, found=found, do="make or download it again")


def read_json(file: Path) -> dict:
    """A JSON object. Raises InputError for a missing, damaged or other file."""
    if not file.is_file():
        raise InputError(str(file), expected="a JSON file", found="no such file", do="check dataset.path")
    try:
        content = json.loads(file.read_text("utf-8-sig"))
    except (ValueError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(str(file), expected="JSON", found=" ".join(str(error).split())[:120]) from None
    if not isinstance(content, dict):
        raise InputError(str(file), expected="a JSON object", found=type(content).__name__)
    return content


def read_stack(
    files: list[Path], size: int | None, mask_of: Callable[[Path], np.ndarray] | None = None
) -> tuple[np.ndarray, bool, tuple[int, int]]:
    """Images of one size, of at most `size` pixels along the longer side (null: as they are): (I, H, W, 4), whether
    they have alpha, and height and width in the files. mask_of: gives the alpha (H, W) of an image that has none."""
    images, alpha, shape = [], None, None
    for file in files:
        image, own = read_image(file)
        if not own and mask_of is not None:
            image, own = _masked(image, mask_of(file), file), True
        shape, alpha = shape or image.shape[:2], own if alpha is None else alpha
        if image.shape[:2] != shape:
            found, expected = (f"{s[1]} x {s[0]} pixels" for s in (image.shape[:2], shape))
            raise InputError(str(file), expected=f"{expected} as in {files[0].name}", found=found)
        if own != alpha:
            found = f"alpha in {(file if own else files[0]).name} and none in {(files[0] if own else file).name}"
            raise InputError(str(file), expected="alpha in all images or in none", found=found)
        images.append(resize(image, *_scaled(shape, size)))
    return np.stack(images), alpha, shape


def _masked(image: np.ndarray, mask: np.ndarray, file: Path) -> np.ndarray:
    if mask.shape != image.shape[:2]:
        found, expected = (f"{s[1]} x {s[0]} pixels" for s in (mask.shape, image.shape[:2]))
        raise InputError(f"mask of {file}", expected=expected, found=found)
    return np.concatenate([image[:, :, :3], mask[:, :, None]], 2)


def _scaled(shape: tuple[int, int], size: int | None) -> tuple[int, int]:
    if size is None or size >= max(shape):
        return shape
    return tuple(max(1, round(n * size / max(shape))) for n in shape)
