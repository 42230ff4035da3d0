"""The typed values that stages hand to each other.

Symbols as in the paper: F frames, N points, B bones, J joints, M curve nodes, C clips, I images. Lengths are in the
unit of the data (``Motion.unit``), angles in radians, +Y is up. A transform is a (3, 4) matrix [A | t] that acts on
*canonical* points: x = A v + t. Everything is float32 unless said otherwise; sums that need it are taken in float64.

A value holds arrays, strings, numbers, tuples of strings, other values or None, and nothing else: that is what lets
the store write it without pickle.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from tasks.errors import InputError


@dataclass(frozen=True)
class Rig:
    """A skeleton that came with the data: the truth that estimated skeletons are held against.

    names: J joint names; parents: (J,) int32, -1 for the root, which is joint 0, every parent before its children;
    joints: (J, 3) rest positions; weights: (N, J) skin weights, rows sum to one;
    rotations: (F, J, 3, 3) local to the parent, relative to rest; translations: (F, J, 3) see :class:`Poses`.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray


@dataclass(frozen=True)
class Motion:
    """A moving shape of fixed topology.

    points: (F, N, 3); faces: (T, 3) int32 or None for bare points; clip_start: (C+1,) int64, clip c is
    frames clip_start[c]:clip_start[c+1]; clip_names: C names; fps: frames a second; unit: "m" or
    "unit" (unknown scale); rest: (N, 3) rest shape, where the data has one; rig: its skeleton, where the data has one.
    """

    name: str
    points: np.ndarray
    faces: np.ndarray | None
    clip_start: np.ndarray
    clip_names: tuple[str, ...]
    fps: float
    unit: str = "unit"
    rest: np.ndarray | None = None
    rig: Rig | None = None

    def __post_init__(self) -> None:
        _check(self.points.ndim == 3 and self.points.shape[2] == 3, "Motion.points", "(F, N, 3)", self.points.shape)
        start = np.asarray(self.clip_start)
        frames = len(self.points)
        well_formed = start.ndim == 1 and len(start) >= 2 and start[0] == 0 and start[-1] == frames
        _check(
            well_formed and bool(np.all(np.diff(start) > 0)),
            "Motion.clip_start",
            f"rising frame numbers from 0 to {frames}",
            start.tolist(),
        )
        _check(len(self.clip_names) == len(start) - 1, "Motion.clip_names", f"{len(start) - 1} names", self.clip_names)

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.points)

    def clips(self) -> list[slice]:
        """The frames of each clip."""
        return [slice(int(a), int(b)) for a, b in zip(self.clip_start[:-1], self.clip_start[1:], strict=True)]

    def take_clips(self, chosen: list[int]) -> Motion:
        """The motion made of the chosen clips, in the order given."""
        return self.take_frames([self.clips()[c] for c in chosen], [self.clip_names[c] for c in chosen])

    def take_frames(self, pieces: list[slice], names: list[str]) -> Motion:
        """The motion made of runs of consecutive frames; each run becomes a clip, so no window can cross a cut."""
        index = np.concatenate([np.arange(p.start, p.stop) for p in pieces])
        start = np.concatenate([[0], np.cumsum([p.stop - p.start for p in pieces])]).astype(np.int64)
        rig = self.rig
        if rig is not None:
            rig = replace(rig, rotations=rig.rotations[index], translations=rig.translations[index])
        return replace(self, points=self.points[index], clip_start=start, clip_names=tuple(names), rig=rig)


@dataclass(frozen=True)
class Capture:
    """Images of a moving thing from known cameras; I images of F distinct times.

    images: (I, H, W, 4) uint8, sRGB colour (not multiplied by alpha) and alpha; has_alpha: False where the data brings
    no alpha (it is 255 everywhere); background: (3,) in 0..1, the colour behind the thing; view: (I, 4, 4) world to
    camera, OpenCV's axes (x right, y down, z forward); intrinsics: (I, 3, 3) in pixels, centres of pixels at +0.5;
    camera: (I,) int32 the number of the camera; frame: (I,) int32 in 0..F-1; times: (F,) in 0..1, rising;
    fps: frames a second; clip_start: (C+1,) int64 and clip_names over the F frames; unit: as in :class:`Motion`;
    rig: the skeleton and its pose in every frame, where the data has one, with weights (0, J) where no mesh belongs
    to it.
    """

    name: str
    images: np.ndarray
    has_alpha: bool
    background: np.ndarray
    view: np.ndarray
    intrinsics: np.ndarray
    camera: np.ndarray
    frame: np.ndarray
    times: np.ndarray
    fps: float
    clip_start: np.ndarray
    clip_names: tuple[str, ...]
    unit: str = "unit"
    rig: Rig | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.images.shape[1], self.images.shape[2]

    def take(self, chosen: np.ndarray) -> Capture:
        """The capture with the chosen images only; frames and times stay as they are."""
        names = ("images", "view", "intrinsics", "camera", "frame")
        return replace(self, **{n: getattr(self, n)[chosen] for n in names})


@dataclass(frozen=True)
class Gaussians:
    """Gaussians at rest. means: (N, 3); scales: (N, 1) isotropic or (N, 3), standard deviations in the data's unit;
    quaternions: (N, 4) w x y z, or None where scales are isotropic; opacities: (N,) in 0..1;
    sh: (N, (d+1)^2, 3) coefficients of real spherical harmonics of degree d = 0..3, as 3DGS files have them:
    colour = 0.5 + sum of sh times basis."""

    means: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray | None
    opacities: np.ndarray
    sh: np.ndarray


@dataclass(frozen=True)
class Reconstruction:
    """Consistent Gaussians in motion: one canonical set and where each of it is in every frame.

    points: (F, N, 3); rotations: (F, N, 4) w x y z against rest, or None; scaling: (F, N) factor on the scales, or
    None; opacity: (F, N) factor on the opacities, or None; times, fps, clip_start, clip_names, unit, rig: as in
    :class:`Capture`; history: (S, 3) iteration, loss, PSNR on the training images in dB, along the fit.
    """

    name: str
    gaussians: Gaussians
    points: np.ndarray
    rotations: np.ndarray | None
    scaling: np.ndarray | None
    opacity: np.ndarray | None
    times: np.ndarray
    fps: float
    clip_start: np.ndarray
    clip_names: tuple[str, ...]
    unit: str
    rig: Rig | None
    history: np.ndarray


@dataclass(frozen=True)
class Canonical:
    """The shape that bones and skeleton are defined on. points: (N, 3); faces: (T, 3) int32 or None; frame: its index
    among the training frames, or -1 for the data's own rest shape; source: how it was chosen."""

    points: np.ndarray
    faces: np.ndarray | None
    frame: int
    source: str


@dataclass(frozen=True)
class Clusters:
    """Rigid motion clusters. labels: (N,) int32 in 0..B-1; transforms: (F, B, 3, 4);
    sound: (N,) bool, False for stray points that must not move bones;
    curve_count, curve_error: the counts tried and the vertex RMSE at each (the automatic choice, for the report)."""

    labels: np.ndarray
    transforms: np.ndarray
    sound: np.ndarray
    curve_count: np.ndarray
    curve_error: np.ndarray


@dataclass(frozen=True)
class Skinning:
    """Free-form bones. weights: (N, B), rows sum to one, few non-zeros; transforms: (F, B, 3, 4) on rest points;
    rest: (N, 3), near the canonical points or those; history: (iterations,) objective, vertex RMSE."""

    rest: np.ndarray
    weights: np.ndarray
    transforms: np.ndarray
    history: np.ndarray


@dataclass(frozen=True)
class Surface:
    """A closed surface round the canonical shape. vertices: (V, 3); faces: (T, 3) int32;
    of_point: (N,) int32, the vertex nearest to each canonical point."""

    vertices: np.ndarray
    faces: np.ndarray
    of_point: np.ndarray


@dataclass(frozen=True)
class Curve:
    """A curve skeleton. nodes: (M, 3); edges: (E, 2) int32, a forest; of_vertex: (V,) int32, the node every surface
    vertex collapsed onto; of_point: (N,) int32, the same for canonical points."""

    nodes: np.ndarray
    edges: np.ndarray
    of_vertex: np.ndarray
    of_point: np.ndarray


@dataclass(frozen=True)
class Skeleton:
    """A kinematic tree with skin weights. names: J names; parents: (J,) int32, joint 0 is the only root (-1), every
    parent before its children; joints: (J, 3) canonical positions; weights: (N, J), rows sum to one."""

    names: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray
    weights: np.ndarray

    def __post_init__(self) -> None:
        parents = np.asarray(self.parents)
        ordered = len(parents) > 0 and parents[0] == -1 and all(0 <= p < j for j, p in enumerate(parents[1:], start=1))
        expected = "one root at index 0 and every parent before its children"
        _check(ordered, "Skeleton.parents", expected, parents.tolist())


@dataclass(frozen=True)
class Poses:
    """Poses of a skeleton. rotations: (F, J, 3, 3) local to the parent, identity at rest;
    translations: (F, J, 3) shift of the joint from its rest offset, in the parent's frame (the root's in the world's;
    for the others zero unless the data's own skeleton stretches); clip_start: (C+1,) int64 as in :class:`Motion`."""

    rotations: np.ndarray
    translations: np.ndarray
    clip_start: np.ndarray


@dataclass(frozen=True)
class Parts:
    """Overlapping groups of joints. names: P names; joints: (P, J) bool; roots: (P,) int32, each part's root joint;
    affinity: (P, B) how much each bone follows each part, columns used as blend weights."""

    names: tuple[str, ...]
    joints: np.ndarray
    roots: np.ndarray
    affinity: np.ndarray


@dataclass(frozen=True)
class Database:
    """Training poses (the key) and bones (the value), frame by frame; windows are cut when matching.
    poses: the training poses; bones: (F, B, 3, 4) transforms on canonical points; fps: frames a second."""

    poses: Poses
    bones: np.ndarray
    fps: float


@dataclass(frozen=True)
class Animation:
    """What a method makes of unseen poses. points: (F, N, 3); bones: (F, B, 3, 4) or None where a method has none;
    sources: (F, P, K) int32 training frames blended for each part, or None; distance: (F, P) distance of the query to
    its best match in radians, or None; parts: P names."""

    points: np.ndarray
    bones: np.ndarray | None = None
    sources: np.ndarray | None = None
    distance: np.ndarray | None = None
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Confidence:
    """How far unseen poses lie from the database. windows: (F, P, K) int32 the training frame that each of a part's
    nearest windows has in the place of the frame; distance: (F, P, K) mean angle to them in radians; expected: (F,)
    error to be expected of matching, in the data's unit, 0 where one clip leaves nothing to judge by; outside: (F,)
    share of training frames that lie nearer to the other clips: near 1 is outside the database; parts: P names."""

    windows: np.ndarray
    distance: np.ndarray
    expected: np.ndarray
    outside: np.ndarray
    parts: tuple[str, ...]


@dataclass(frozen=True)
class Metrics:
    """Numbers of one case. names: metric names, units: theirs, values: (K,) float64."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray


@dataclass(frozen=True)
class About:
    """A dataset in words. name: the subject's; notes: what is unusual about it, one line each."""

    name: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Picture:
    """A figure. name: its file's stem; caption: one line for readers; png: (bytes,) uint8, the content of a PNG file,
    or None for a drawing, whose text is svg."""

    name: str
    caption: str
    png: np.ndarray | None = None
    svg: str = ""
    webp: np.ndarray | None = None

    @property
    def suffix(self) -> str:
        """Of the picture's file."""
        if self.webp is not None:
            return "webp"
        return "svg" if self.png is None else "png"

    @property
    def data(self) -> bytes:
        """The content of the picture's file."""
        pixels = self.png if self.webp is None else self.webp
        return self.svg.encode() if pixels is None else pixels.tobytes()


@dataclass(frozen=True)
class Cloth:
    """The state of simulated cloth between two frames. points: (N, 3) metres; velocities: (N, 3) metres a second."""

    points: np.ndarray
    velocities: np.ndarray


@dataclass(frozen=True)
class Files:
    """Files that a report brings along, one or more. paths: n, where they lie in the report's folder; content: (bytes,)
    uint8, one after another; start: (n + 1,) int64, where each begins."""

    paths: tuple[str, ...]
    content: np.ndarray
    start: np.ndarray

    @staticmethod
    def of(files: dict[str, bytes]) -> Files:
        """From the bytes by their paths."""
        sizes = [len(data) for data in files.values()]
        content = np.frombuffer(b"".join(files.values()), np.uint8)
        return Files(tuple(files), content, np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64))

    def items(self) -> list[tuple[str, bytes]]:
        """Paths and bytes."""
        data = [self.content[a:b].tobytes() for a, b in zip(self.start[:-1], self.start[1:], strict=True)]
        return list(zip(self.paths, data, strict=True))


@dataclass(frozen=True)
class Training:
    """All that a method may learn from: nothing of the test clips is in here."""

    motion: Motion
    canonical: Canonical
    skinning: Skinning
    skeleton: Skeleton
    database: Database
    parts: Parts


_IMAGES = (Capture, Gaussians, Reconstruction)
_KINDS = (Rig, Motion, Canonical, Clusters, Skinning, Surface, Curve, Skeleton, Poses, Parts, Database, Training)
VALUES = {
    kind.__name__: kind for kind in (*_KINDS, *_IMAGES, Animation, Confidence, Metrics, About, Picture, Cloth, Files)
}


def same(a: object, b: object) -> bool:
    """True when two values hold the same bits."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if type(a) in VALUES.values():
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return a == b


def _check(ok: bool, where: str, expected: str, found: object) -> None:
    if not ok:
        raise InputError(where, expected=expected, found=str(found))
