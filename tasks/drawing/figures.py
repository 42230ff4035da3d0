"""Pictures of results: every function takes values and returns an (H, W, 3) uint8 RGB image or the text of an SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from tasks.drawing import plot, render
from tasks.drawing.colours import CLAY, bone_colours, error_map, part_colours, weight_map
from tasks.evaluation.metrics import frame_rmse, squared_errors, unit_of
from tasks.geometry import kinematics, measure
from tasks.values import Canonical, Clusters, Motion, Parts, Skeleton, Skinning

PICTURE = 330  # side of a square picture in a figure, in pixels; others have its area
ELEVATION = 0.18
WORN_FROM = 0.5  # azimuth of pictures of clothes, in radians off the front
EYE = 5.0  # the eye's distance in bounding radii
CAPTION = 30  # height of a line of text under a picture


@dataclass(frozen=True)
class Shape:
    """What is drawn again and again: the faces, or the points' radius where there are none."""

    faces: np.ndarray | None
    radius: float

    def paint(
        self, canvas: np.ndarray, camera: render.Camera, points: np.ndarray, colours: np.ndarray, **glass
    ) -> None:
        """Draws the points as a surface or as spheres; glass: opacity and rim of :func:`render.paint_mesh`."""
        if self.faces is not None:
            render.paint_mesh(canvas, camera, points, self.faces, colours, **glass)
        else:
            render.paint_points(canvas, camera, points, colours, self.radius * (0.5 if glass else 1.0))


def shape_of(points: np.ndarray, faces: np.ndarray | None) -> Shape:
    """How to draw points (N, 3): as a surface where there are faces, else as spheres that nearly touch."""
    if faces is not None:
        return Shape(faces, 0.0)
    near, _ = cKDTree(points).query(points, k=min(2, len(points)))
    return Shape(None, 0.75 * float(np.median(near[:, -1])) or 0.01 * measure.diagonal(points))


def azimuth_of(motion: Motion) -> float:
    """Where all pictures of a subject are taken from: its broad side, and the front where it travels. In radians.

    What is as broad one way as the other, such as a dress, is seen from the broad side of the skeleton in it.
    """
    first = motion.clips()[0]
    start = motion.points[first.start]
    rig = motion.rig
    if rig is None or render.longish(start):
        azimuth = render.broadside(start)
    else:
        pose = slice(first.start, first.start + 1)
        posed = kinematics.forward(rig.parents, rig.joints, rig.rotations[pose], rig.translations[pose])
        azimuth = render.broadside(kinematics.joint_positions(posed, rig.joints)[0])
    travel = motion.points[first.stop - 1].mean(0) - start.mean(0)
    towards_eye = travel[0] * np.sin(azimuth) + travel[2] * np.cos(azimuth)
    away = towards_eye < 0 and np.hypot(travel[0], travel[2]) > 0.2 * measure.diagonal(start)
    return azimuth + np.pi if away else azimuth


def error_figure(
    test: Motion,
    results: Mapping[str, np.ndarray],
    diagonal: float,
    *,
    focus: str,
    azimuth: float,
    theme: str = "light",
) -> np.ndarray:
    """Truth and methods side by side, coloured by vertex error on one scale, in the median and the worst frame.

    results: label -> (F, N, 3) on the frames of ``test``; diagonal: of the canonical bounding box; focus: the label
    whose frames are ranked. The scale ends at the 99th percentile of the errors shown, rounded up.
    """
    chosen = _chosen_frames(test, results[focus])
    unit, factor = unit_of("length", test.unit)
    if unit == "unit":  # says nothing by itself
        unit, factor = "% of diagonal", 100.0 / diagonal
    frames = list(chosen.values())
    errors = {name: factor * np.sqrt(squared_errors(p[frames], test.points[frames])) for name, p in results.items()}
    top = plot.round_up(float(np.quantile(np.stack(list(errors.values())), 0.99)), (1, 1.5, 2, 3, 4, 5, 6, 8, 10))
    cameras = _cameras(test.points[frames], azimuth)
    shape = shape_of(test.points[0], test.faces)
    rows = []
    for i, (rank, frame) in enumerate(chosen.items()):
        truth = panel(shape, cameras[i], test.points[frame], CLAY, [f"truth, {rank} frame", _place(test, frame)], theme)
        row = [truth]
        for name, points in results.items():
            rmse = math.sqrt(float(np.mean(errors[name][i] ** 2)))
            lines = [name, f"RMSE {rmse:.{_digits(top)}f} {'mm' if unit == 'mm' else '%'}"]
            row.append(panel(shape, cameras[i], points[frame], error_map(errors[name][i] / top), lines, theme))
        rows.append(np.hstack(row))
    sheet = np.vstack(rows)
    return render.finish(beside([sheet, colour_bar(len(sheet), error_map, top, unit, theme)], theme))


def skeleton_figure(
    canonical: Canonical, skeleton: Skeleton, parts: Parts | None, *, azimuth: float, theme: str = "light"
) -> np.ndarray:
    """The skeleton inside the translucent shape, from two sides; joints in the colour of their part, the root white."""
    shape = shape_of(canonical.points, canonical.faces)
    colours = _joint_colours(skeleton, parts)
    lines = [f"{len(skeleton.parents)} joints"] if parts is None else []

    def joints(canvas: np.ndarray, camera: render.Camera) -> None:
        render.paint_skeleton(canvas, camera, skeleton.joints, skeleton.parents, colours, size=9, theme=theme)

    points = canonical.points
    seen = np.concatenate([points, skeleton.joints])  # hands stand out of a dress
    sides = [_cameras(seen[None], azimuth + turn)[0] for turn in (0.0, 0.5 * np.pi)]
    glass = {"opacity": 0.16, "rim": 0.5}
    pictures = [panel(shape, side, points, CLAY * 0.9, lines, theme, joints, **glass) for side in sides]
    if parts is None:
        return render.finish(beside(pictures, theme))
    names = [f"{len(skeleton.parents)} joints", *parts.names]
    legend = _legend(max(map(len, pictures)), names, [None, *part_colours(len(parts.names))], theme)
    return render.finish(beside([*pictures, legend], theme))


def parts_figure(
    canonical: Canonical, skinning: Skinning, parts: Parts, *, azimuth: float, theme: str = "light"
) -> np.ndarray:
    """How much each point follows each part, W affinity^T: all parts in their colours, then each part by itself."""
    shape = shape_of(canonical.points, canonical.faces)
    follow = skinning.weights.astype(np.float32) @ parts.affinity.astype(np.float32).T  # (N, P)
    points = canonical.points
    camera = _cameras(points[None], azimuth)[0]
    colours = part_colours(len(parts.names))
    pictures = [panel(shape, camera, points, follow @ colours, ["all parts"], theme)]
    for p, name in enumerate(parts.names):
        mixed = CLAY + follow[:, p : p + 1] * (colours[p] - CLAY)
        pictures.append(panel(shape, camera, points, mixed, [name], theme))
    return render.finish(grid(pictures, 3, theme))


def bones_figure(canonical: Canonical, skinning: Skinning, *, azimuth: float, theme: str = "light") -> np.ndarray:
    """The bones' weights as mixed colours, from two sides, and the number of bones that share a point."""
    shape = shape_of(canonical.points, canonical.faces)
    weights = skinning.weights.astype(np.float32)
    shared = 1.0 / np.maximum((weights**2).sum(1), 1e-9)  # 1 where one bone rules, 4 where four have equal shares
    points = canonical.points
    front, back = (_cameras(points[None], azimuth + turn)[0] for turn in (0.0, np.pi))
    mixed = weights @ bone_colours(weights.shape[1])
    count = f"{weights.shape[1]} bones"
    pictures = [
        panel(shape, front, points, mixed, [count], theme),
        panel(shape, back, points, mixed, ["the other side"], theme),
        panel(shape, front, points, weight_map((shared - 1) / 3), ["bones that share a point"], theme),
    ]
    pictures.append(colour_bar(len(pictures[0]), weight_map, 4.0, "bones", theme, low=1.0))
    return render.finish(beside(pictures, theme))


def count_figure(clusters: Clusters, diagonal: float) -> str:
    """Error of rigid clusters against their number, with the chosen number marked. -> SVG."""
    chosen = int(clusters.transforms.shape[1])
    series = [plot.Series("rigid clusters", clusters.curve_count, 100.0 * clusters.curve_error / diagonal)]
    return plot.lines(series, x="clusters", y="vertex RMSE [% of diagonal]", marks=[(chosen, f"chosen: {chosen}")])


def worn_figure(
    panels: Mapping[str, tuple[np.ndarray, np.ndarray]], skin: np.ndarray, cloth: np.ndarray, *, theme: str = "light"
) -> np.ndarray:
    """Cloth on a body, one picture a frame, from its front. panels: caption -> points of the body, of the cloth;
    skin, cloth: their faces."""
    first = next(iter(panels.values()))[0]
    shape = Shape(np.concatenate([skin, cloth + len(first)]), 0.0)
    pictures = []
    for caption, (body, worn) in panels.items():
        points = np.concatenate([body, worn])
        colours = np.repeat([CLAY, part_colours(1)[0]], [len(body), len(worn)], axis=0)
        camera = _cameras(points[None], WORN_FROM)[0]
        pictures.append(panel(shape, camera, points, colours, [caption], theme))
    return render.finish(_sheet(pictures, theme))


def frames_figure(
    panels: Mapping[str, np.ndarray], faces: np.ndarray | None, *, azimuth: float, theme: str = "light"
) -> np.ndarray:
    """One shape in several frames. panels: caption -> points (N, 3); faces: (T, 3) or None."""
    shape = shape_of(next(iter(panels.values())), faces)
    cameras = _cameras(np.stack(list(panels.values())), azimuth)
    shown = zip(panels.items(), cameras, strict=True)
    return render.finish(_sheet([panel(shape, c, points, CLAY, [text], theme) for (text, points), c in shown], theme))


def _sheet(pictures: list[np.ndarray], theme: str) -> np.ndarray:
    """Pictures of any size, four in a row."""
    tallest, widest = (max(p.shape[axis] for p in pictures) for axis in (0, 1))
    return grid([_on_paper(p, tallest, widest, theme) for p in pictures], 4, theme)


def _on_paper(picture: np.ndarray, height: int, width: int, theme: str) -> np.ndarray:
    """A picture in the middle of a larger sheet, both in canvas pixels."""
    sheet = np.empty((height, width, 3), np.uint8)
    sheet[:] = render.to_bytes(render.PAPER[theme])
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def _cameras(frames: np.ndarray, azimuth: float) -> list[render.Camera]:
    """One camera a frame: each centred on its frame, all of the scale and picture size that fit the largest.

    Pictures are as wide or high as the shapes ask for and all of one area.
    """

    def look(points: np.ndarray, width: int, height: int) -> render.Camera:
        size = {"width": width, "height": height, "distance": EYE, "margin": 0.05}
        return render.look(points, azimuth=azimuth, elevation=ELEVATION, **size)

    spans = []
    for points in frames:
        camera = look(points, PICTURE, PICTURE)
        spans.append(np.ptp(camera.project(points)[0], axis=0) / camera.scale)
    across, up = np.max(spans, axis=0)
    stretch = math.sqrt(np.clip(across / up, 0.6, 1.4))
    cameras = [look(points, round(PICTURE * stretch), round(PICTURE / stretch)) for points in frames]
    widest = min(cameras, key=lambda c: c.scale)
    return [replace(c, scale=widest.scale, distance=widest.distance) for c in cameras]


def panel(
    shape: Shape,
    camera: render.Camera,
    points: np.ndarray,
    colours: np.ndarray,
    lines: list[str],
    theme: str,
    inside: Callable[[np.ndarray, render.Camera], None] | None = None,
    **glass: float,
) -> np.ndarray:
    """One picture with centred lines of text under it; what is ``inside`` is painted before the glass over it."""
    width, height = camera.width // render.SUPERSAMPLE, camera.height // render.SUPERSAMPLE
    canvas = render.blank(width, height, theme)
    if inside is not None:
        inside(canvas, camera)
    shape.paint(canvas, camera, points, colours, **glass)
    strip = render.blank(width, 8 + CAPTION * len(lines), theme) if lines else render.blank(width, 0, theme)
    for i, line in enumerate(lines):
        render.text(
            strip, line, (width / 2, 18 + 24 * i), size=15, align="middle", bold=i == 0, theme=theme, room=width - 8
        )
    return np.vstack([canvas, strip])


def grid(pictures: list[np.ndarray], columns: int, theme: str) -> np.ndarray:
    height, width = (n // render.SUPERSAMPLE for n in pictures[0].shape[:2])
    columns = min(columns, len(pictures))
    empty = [render.blank(width, height, theme)] * (-len(pictures) % columns)
    every = [*pictures, *empty]
    return np.vstack([np.hstack(every[i : i + columns]) for i in range(0, len(every), columns)])


def beside(pictures: list[np.ndarray], theme: str) -> np.ndarray:
    """Pictures side by side; those of less height get paper above and below."""
    tallest = max(len(p) for p in pictures)
    out = []
    for picture in pictures:
        room = np.empty((tallest, *picture.shape[1:]), np.uint8)
        room[:] = render.to_bytes(render.PAPER[theme])
        top = (tallest - len(picture)) // 2
        room[top : top + len(picture)] = picture
        out.append(room)
    return np.hstack(out)


def colour_bar(height: int, colour: Callable, top: float, unit: str, theme: str, low: float = 0.0) -> np.ndarray:
    """A colour bar for a sheet of ``height`` canvas pixels, from low to top in the unit."""
    height //= render.SUPERSAMPLE
    tall = min(320, height - 60)
    first = (height - tall) // 2
    canvas = render.blank(104, height, theme)
    s = render.SUPERSAMPLE
    ramp = render.to_bytes(colour(np.linspace(1, 0, tall * s)))
    canvas[first * s : (first + tall) * s, 10 * s : 26 * s] = ramp[:, None]
    step = plot.round_up((top - low) / 5, (1, 2, 5, 10))
    for value in np.arange(low, top + step / 2, step):
        y = first + tall * (top - value) / (top - low)
        render.text(canvas, f"{value:.3g}", (32, y + 5), size=13, theme=theme)
    render.text(canvas, unit, (10, first - 16), size=13, theme=theme)
    return canvas


def _legend(height: int, names: list[str], colours: list, theme: str) -> np.ndarray:
    """Names beside discs of their colours; None for a heading."""
    height //= render.SUPERSAMPLE
    canvas = render.blank(150, height, theme)
    y = height / 2 - 13 * len(names)
    for name, colour in zip(names, colours, strict=True):
        if colour is not None:
            render.disc(canvas, (18, y - 5), 7, colour)
        render.text(canvas, name, (10 if colour is None else 32, y), size=14, bold=colour is None, theme=theme)
        y += 26
    return canvas


def _joint_colours(skeleton: Skeleton, parts: Parts | None) -> np.ndarray:
    """The colour of the smallest part that holds the joint: overlaps go to the limb."""
    if parts is None:
        return np.repeat(part_colours(1), len(skeleton.parents), 0)
    size = np.where(parts.joints, parts.joints.sum(1)[:, None], np.iinfo(np.int64).max)  # (P, J)
    return part_colours(len(parts.names))[size.argmin(0)]


def _chosen_frames(test: Motion, points: np.ndarray) -> dict[str, int]:
    order = np.argsort(frame_rmse(points, test.points), kind="stable")
    return {"median": int(order[len(order) // 2]), "worst": int(order[-1])}


def _place(motion: Motion, frame: int) -> str:
    clip = int(np.searchsorted(motion.clip_start, frame, side="right")) - 1
    return f"{motion.clip_names[clip]}, frame {frame - int(motion.clip_start[clip])}"


def _digits(top: float) -> int:
    """Decimals that give a scale's end three significant digits."""
    return max(2 - math.floor(math.log10(top)), 0)
