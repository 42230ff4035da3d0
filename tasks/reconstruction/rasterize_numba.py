"""The rasteriser on the processor: numba kernels behind torch's autograd."""

from __future__ import annotations

import numpy as np
import torch

from tasks.errors import InputError
from tasks.geometry.parallel import for_chunks
from tasks.reconstruction import splat_blend, splat_project
from tasks.reconstruction.splat_blend import DEPTH, MOMENTS, SPLAT, TILE, X, Y

GAUSSIANS = 16384  # a chunk of them: a thread costs as much as a few thousand
TILES = 64


def draw(means, scales, opacities, sh, view, intrinsics, size, background, quaternions):
    """See :func:`tasks.reconstruction.rasterize.rasterize`. float32 or float64 on the processor."""
    return _Draw.apply(means, scales, opacities, sh, quaternions, view, intrinsics, background, size)


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, scales, opacities, sh, quaternions, view, intrinsics, background, size):
        if means.device.type != "cpu" or means.dtype not in (torch.float32, torch.float64):
            found = f"{means.dtype} on {means.device}"
            raise InputError("rasterize.backend=numba", expected="float32 or float64 on the processor", found=found)
        inputs = [None if t is None else _array(t) for t in (means, scales, opacities, sh, quaternions)]
        camera = [_array(t) for t in (view, intrinsics, background)]
        drawing = _Drawing(inputs, camera, (int(size[0]), int(size[1])))
        images = tuple(torch.from_numpy(image) for image in drawing.forward())
        ctx.drawing = drawing
        ctx.save_for_backward(means, scales, opacities, sh, quaternions, *images)
        return images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, of_rgb, of_alpha, of_depth):
        _ = ctx.saved_tensors  # complains where one was overwritten since
        slopes = tuple(_array(g) for g in (of_rgb, of_alpha, of_depth))
        gradients = [None if g is None else torch.from_numpy(g) for g in ctx.drawing.backward(slopes)]
        of_background = None
        if ctx.needs_input_grad[7]:
            alpha = torch.from_numpy(ctx.drawing.images[1])
            of_background = torch.einsum("hwc,hw->c", of_rgb, 1.0 - alpha)
        return (*gradients, None, None, of_background, None)


class _Drawing:
    """One view being drawn: what the way there leaves for the way back."""

    def __init__(self, inputs: list, camera: list, size: tuple[int, int]) -> None:
        self.inputs, self.camera, self.size = inputs, camera, size
        self.across, self.down = -(-size[1] // TILE), -(-size[0] // TILE)

    def forward(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """rgb (H, W, 3), alpha (H, W), depth (H, W)."""
        means, scales, opacities, sh, quaternions = self.inputs
        view, intrinsics, background = self.camera
        splats = np.empty((len(means), SPLAT), means.dtype)

        def project(a: int, b: int) -> None:
            splat_project.project(a, b, means, scales, opacities, sh, quaternions, view, intrinsics, self.size, splats)

        for_chunks(project, len(means), GAUSSIANS)
        near_first = _by_depth(splats[:, DEPTH])
        self.order = self._by_place(splats, near_first)
        self.splats = splats[self.order]
        row_of = np.empty(len(means), np.int64)
        row_of[self.order] = np.arange(len(self.order))
        near_first = row_of[near_first]
        counts = np.empty(len(self.order), np.int64)

        def count(a: int, b: int) -> None:
            splat_blend.count_pairs(a, b, self.splats, self.across, self.down, counts)

        for_chunks(count, len(counts), GAUSSIANS)
        self.pair_start = np.concatenate([[0], np.cumsum(counts)])
        pairs = splat_blend.list_pairs(self.splats, near_first, self.across, self.down, self.pair_start)
        self.tile_start, self.splat_of, self.number_of = pairs
        self.tile_end = np.empty(self.across * self.down, np.int64)
        self.images = (
            np.empty((*self.size, 3), means.dtype),
            np.empty(self.size, means.dtype),
            np.empty(self.size, means.dtype),
        )

        def blend(a: int, b: int) -> None:
            lists = self.tile_start, self.splat_of
            splat_blend.blend(a, b, self.across, self.splats, *lists, background, *self.images, self.tile_end)

        for_chunks(blend, len(self.tile_end), TILES)
        return self.images

    def _by_place(self, splats: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """The drawn Gaussians in the order of the tiles that their centres lie in: what a tile needs lies together."""
        column = np.clip(splats[drawn, X] / TILE, 0, self.across - 1).astype(np.int32)
        row = np.clip(splats[drawn, Y] / TILE, 0, self.down - 1).astype(np.int32)
        tile = row * self.across + column
        if self.across * self.down <= np.iinfo(np.uint16).max:
            tile = tile.astype(np.uint16)  # which numpy sorts by radix
        return drawn[np.argsort(tile, kind="stable")]

    def backward(self, slopes: tuple[np.ndarray, np.ndarray, np.ndarray]) -> list[np.ndarray | None]:
        """Gradients of means, scales, opacities, sh and quaternions, from those of the three images."""
        means, scales, _, sh, quaternions = self.inputs
        view, intrinsics, background = self.camera
        moments = np.zeros((len(self.splat_of), MOMENTS), means.dtype)

        def blend(a: int, b: int) -> None:
            lists = self.tile_start, self.tile_end, self.splat_of, self.number_of
            splat_blend.blend_backward(a, b, self.across, self.splats, *lists, background, self.images, slopes, moments)

        for_chunks(blend, len(self.tile_end), TILES)
        gradients = tuple(None if x is None else np.zeros_like(x) for x in self.inputs)

        def project(a: int, b: int) -> None:
            pairs = self.order, self.splats, self.pair_start, moments
            splat_project.project_backward(
                a, b, means, scales, sh, quaternions, view, intrinsics, self.size, *pairs, gradients
            )

        for_chunks(project, len(self.order), GAUSSIANS)
        return list(gradients)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _by_depth(depth: np.ndarray) -> np.ndarray:
    """Numbers of the finite depths from near to far, equal ones in their own order."""
    if depth.dtype == np.float32:  # positive floats are ordered as their bits are: one fast sort of integers
        keys = (depth.view(np.uint32).astype(np.uint64) << np.uint64(32)) | np.arange(len(depth), dtype=np.uint64)
        keys.sort()
        order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
    else:
        order = np.argsort(depth, kind="stable")
    return order[: int(np.isfinite(depth).sum())]
