"""The steps of a fit: state, one step, what happens between steps, and the result."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace

import numpy as np
import torch
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.reconstruction import checkpoint, cuts, density
from tasks.reconstruction.adam import Adam
from tasks.reconstruction.curriculum import Schedule, Window
from tasks.reconstruction.deformed import Deformed
from tasks.reconstruction.hull import Start, ball_start, hull_start
from tasks.reconstruction.losses import photometric
from tasks.reconstruction.mlp import Mlp
from tasks.reconstruction.nodes import Nodes
from tasks.reconstruction.rasterize import rasterize
from tasks.reconstruction.rigidity import Neighbourhood
from tasks.reconstruction.splines import Spline, spline
from tasks.reconstruction.visibility import shown
from tasks.values import Capture, Gaussians, Reconstruction
from tasks.workspace import Workspace

REPORT = 100  # steps between two lines of history
SAVE_SECONDS = 60.0  # between checkpoints; they change no bit of the result
AVERAGE_EVERY = 10  # steps between two states that the mean at the end takes in
OPACITY = 0.5  # at the start
OVERLAP = 0.6  # scale at the start, in distances to the nearest neighbours


def run(capture: Capture, recipe: SimpleNamespace, workspace: Workspace) -> Reconstruction:
    """Fits, from the last checkpoint where there is one. recipe: the settings of the function ``fit``."""
    cuts.check(capture)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums then come out the same whatever the machine has; the rasteriser has its own threads
    try:
        fitting = Fitting(capture, recipe, workspace)
        fitting.resume()
        saved = time.monotonic()
        while fitting.iteration < recipe.iterations:
            fitting.step()
            if time.monotonic() - saved > SAVE_SECONDS:
                fitting.save()
                saved = time.monotonic()
        return fitting.result()
    finally:
        torch.set_num_threads(threads)


class Fitting:
    """The state of a fit. Inside, the thing lies round the origin with about unit size."""

    def __init__(self, capture: Capture, recipe: SimpleNamespace, workspace: Workspace) -> None:
        self.capture, self.recipe, self.workspace = capture, recipe, workspace
        self.schedule = Schedule(recipe.iterations, recipe.static, recipe.grown, recipe.coarsest, recipe.full)
        self.device = "cuda" if recipe.backend == "gsplat" else "cpu"
        self.rng = np.random.default_rng(recipe.seed)
        workspace.say("where the thing is", 0.0)
        self.start = self._start()
        low, high = self.start.points.min(0), self.start.points.max(0)
        self.centre = (low.astype(np.float64) + high) / 2
        self.unit = float(np.linalg.norm(high.astype(np.float64) - low) / 2)
        self.window = Window(capture, self.start, recipe.hull_views)
        self.share = min(1.0, recipe.largest / max(capture.size))
        self.iteration = 0
        self.params = self._params()
        self.deformation: Nodes | Mlp | None = None
        self.neighbours: Neighbourhood | None = None
        self.adam, self.pull = Adam(), density.Pull(recipe.gaussians)
        self.queue = np.zeros(0, np.int64)
        self.frames: list[tuple[int, int]] = []
        self.sums = np.zeros(2)  # of loss and squared error since the last line of history
        self.history: list[list[float]] = []
        self.mean: dict[str, torch.Tensor] = {}
        self.averaged = 0
        self._views, self._size = None, -1
        self._clock = (0, time.monotonic())

    def _start(self) -> Start:
        recipe, capture = self.recipe, self.capture
        if recipe.reference is not None and recipe.reference not in capture.frame:
            expected = f"a frame with an image, or null ({capture.name} has frames up to {int(capture.frame.max())})"
            raise InputError("reconstruction.reference", expected=expected, found=str(recipe.reference))
        if recipe.start == "ball" or not capture.has_alpha:
            return ball_start(capture, frame=recipe.reference, count=2 * recipe.gaussians, rng=self.rng)
        return hull_start(
            capture,
            frame=recipe.reference,
            views=recipe.hull_views,
            agree=recipe.hull_agree,
            cells=recipe.hull_cells,
        )

    def _params(self) -> dict[str, torch.Tensor]:
        points = ((self.start.points - self.centre) / self.unit).astype(np.float32)
        count, random = self.recipe.gaussians, self.rng
        means = points[random.choice(len(points), count, replace=len(points) < count)]
        means += random.uniform(-0.5, 0.5, means.shape).astype(np.float32) * np.float32(self.start.spacing / self.unit)
        near = cKDTree(means).query(means, k=min(4, count))[0].reshape(count, -1)[:, 1:]
        scale = near.mean(1, keepdims=True) if near.size else np.ones((count, 1))
        made = {
            "means": means,
            "log_scales": np.log(np.maximum(OVERLAP * scale, 1e-4)),
            "opacities": np.full(count, math.log(OPACITY / (1 - OPACITY))),
            "sh": np.zeros((count, (self.recipe.sh_degree + 1) ** 2, 3)),
        }
        return {n: torch.tensor(a, dtype=torch.float32, device=self.device) for n, a in made.items()}

    def learned(self) -> dict[str, torch.Tensor]:
        """All parameters by name."""
        if self.deformation is None:
            return self.params
        own = {"table": self.deformation.table} if isinstance(self.deformation, Nodes) else self.deformation.layers
        return self.params | own

    # one step

    def step(self) -> None:
        """One image, one step of Adam, and what is due after it."""
        self._begin()
        i = self._next_image()
        view = self._views[i]
        for p in self.learned().values():
            p.requires_grad_()
        terms, squared, means = self._loss(view, int(self.capture.frame[i]))
        loss = sum(terms.values())
        self._check_finite(terms)
        loss.backward()
        self.pull.add(means.grad)
        self.iteration += 1
        for name, value in self.learned().items():
            if value.grad is not None:
                self.adam.step(name, value, self._rate(name), self.iteration)
        self.sums += loss.item(), squared.item()
        self._after()

    def _loss(self, view: cuts.View, frame: int) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
        recipe, params = self.recipe, self.params
        (means, scales, opacities), moved = self._drawn(frame)
        terms = {} if moved is None else self._rigidity(moved) | self._roughness()
        if means is not params["means"]:
            means.retain_grad()
        background = self._background()
        colour, alpha, _ = rasterize(
            means,
            self._blurred(scales, view),
            opacities,
            params["sh"],
            view.view,
            view.intrinsics,
            view.size,
            background,
            backend=recipe.backend,
        )
        seen, squared = photometric(colour, alpha, view, background, structure=recipe.structure, cover=recipe.cover)
        return seen | terms, squared, means

    def _drawn(self, frame: int) -> tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], Deformed | None]:
        """Means, scales and opacities in a frame, and what the deformation says."""
        means, scales, opacities = (self.params[n] for n in ("means", "log_scales", "opacities"))
        moved = None if self.deformation is None else self.deformation.at(frame, means)
        if moved is not None:
            means = moved.means
            scales = scales if moved.log_scales is None else scales + moved.log_scales
            opacities = opacities if moved.opacities is None else opacities + moved.opacities
        return (means, torch.exp(scales), torch.sigmoid(opacities)), moved

    def _blurred(self, scales: torch.Tensor, view: cuts.View) -> torch.Tensor:
        """Scales that make the rendered image less sharp at first: an outline then pulls from further away."""
        left = self.recipe.blur * (1.0 - self.schedule.sharpness(self.iteration))
        if left == 0.0:
            return scales
        pixel = view.view[2, 3] / view.intrinsics[0, 0]  # at the depth of the thing's middle
        return torch.sqrt(scales.square() + left * pixel.square())

    def _rigidity(self, moved: Deformed) -> dict[str, torch.Tensor]:
        recipe = self.recipe
        if recipe.arap == "off":
            return {}
        rigid, kept = self.neighbours.rigidity(moved.carriers, moved.turns if recipe.arap == "own" else None)
        falls = self._fall(recipe.rigidity_end)
        return {"arap": falls * recipe.arap_weight * rigid, "distance": falls * recipe.distance_weight * kept}

    def _roughness(self) -> dict[str, torch.Tensor]:
        rough = self.deformation.roughness() if self.recipe.smooth_weight > 0 else None
        return {} if rough is None else {"smooth": self.recipe.smooth_weight * rough}

    def _background(self) -> torch.Tensor:
        """The data's own, or any colour where alpha tells the thing from it: nothing can then hide in it."""
        known = self.rng.random(3) if self.capture.has_alpha else self.capture.background
        return torch.tensor(known, dtype=torch.float32, device=self.device)

    def _check_finite(self, terms: dict[str, torch.Tensor]) -> None:
        for name, value in terms.items():
            if not math.isfinite(value.item()):
                raise InputError(
                    f"{self.capture.name}: iteration {self.iteration}",
                    expected="a finite loss",
                    found=f"{name} = {value.item()}",
                    do="check the cameras, or lower reconstruction.rate_deformation and rate_means",
                )

    def _rate(self, name: str) -> float:
        known = {"means": "means", "log_scales": "scales", "opacities": "opacities", "sh": "colours"}
        return getattr(self.recipe, f"rate_{known.get(name, 'deformation')}") * self._fall(self.recipe.rate_end)

    def _fall(self, end: float) -> float:
        """What is left of a rate or a weight."""
        along = self.iteration / self.recipe.iterations
        return end**along if end > 0 else 1.0 - along

    # what is due before and after a step

    def _begin(self) -> None:
        size = self.schedule.size(self.iteration)
        if size != self._size:
            share = self.share * self.schedule.sizes()[size]
            h, w = self.capture.size
            self.workspace.check_memory(4e-9 * len(self.capture.images) * h * w * share**2)
            self._views = cuts.Views(self.capture, share, self.centre, self.unit, self.device)
            self._size = size
        if self.deformation is None and self.schedule.moving(self.iteration):
            self._set_in_motion()

    def _set_in_motion(self) -> None:
        recipe = self.recipe
        solid = torch.sigmoid(self.params["opacities"].detach()) > density.TRANSPARENT
        points = self.params["means"].detach()[solid].cpu().numpy()
        if recipe.deformation == "nodes":
            self.deformation = Nodes.placed(self._spline(), points, recipe.carriers)
        else:
            self.deformation = Mlp.placed(self.capture.times, points, recipe.carriers, recipe.seed, **self._network())
        self._bind()

    def _bind(self) -> None:
        if self.deformation is not None:
            self.deformation.bind(self.params["means"].detach().cpu().numpy())
            self.neighbours = self.neighbours or Neighbourhood(self.deformation.rest, self.recipe.neighbours)

    def _network(self) -> dict:
        return {"device": self.device} | {n: getattr(self.recipe, n) for n in ("depth", "width", "skip", "deltas")}

    def _spline(self) -> Spline:
        spacing = self.recipe.images_per_knot * len(self.capture.times) / len(self.capture.images)
        return spline(np.asarray(self.capture.clip_start), max(1.0, spacing, self.recipe.frames_per_knot))

    def _next_image(self) -> int:
        """Every image in use once, in random order, then again; while the window grows every other step goes to its
        edge, so that each frame is followed before the next one comes in."""
        if self.deformation is not None:
            frames = self.window.frames(self.schedule.growth(self.iteration))
            if frames != self.frames:
                self.frames = frames
                for clip, (first, last) in enumerate(frames):
                    if last >= first:
                        self.deformation.copy_outwards(first, last, clip)
        if self.iteration % 2 and self.frames:
            edge = self.window.edge(self.frames)
            if len(edge):
                return int(self.rng.choice(edge))
        if len(self.queue) == 0:
            used = self.window.images(self.frames) if self.frames else self.window.first_images
            self.queue = self.rng.permutation(used)
        i, self.queue = int(self.queue[0]), self.queue[1:]
        return i

    def _after(self) -> None:
        recipe, along = self.recipe, self.iteration / self.recipe.iterations
        if self.iteration % recipe.divide_every == 0:
            if along <= recipe.divide_until and recipe.least_shown > 0 and self._all_are_shown():
                self._remove_hidden()
            elif along <= recipe.divide_until:
                density.divide(self.params, self.adam, self.pull, recipe.max_gaussians, recipe.growth, self.rng)
            self.pull = density.Pull(len(self.params["means"]))
            self._bind()
        if along > 1.0 - recipe.averaged and along > recipe.divide_until and self.iteration % AVERAGE_EVERY == 0:
            self.averaged += 1
            for name, value in self.learned().items():
                mean = self.mean.setdefault(name, torch.zeros_like(value, requires_grad=False))
                mean += (value.detach() - mean) / self.averaged
        if self.iteration % REPORT == 0 or self.iteration == recipe.iterations:
            self._report()

    def _all_are_shown(self) -> bool:
        """True at the first division with every frame in use, and at the last one of all."""
        recipe, grown = self.recipe, self.recipe.grown * self.recipe.iterations
        first = self.iteration - recipe.divide_every < grown <= self.iteration
        return first or self.iteration + recipe.divide_every > recipe.divide_until * recipe.iterations

    def _remove_hidden(self) -> None:
        """Takes out what the training images show least of; the steps that follow close what opens."""
        drawn = ((self._views[i], self._drawn(int(f))[0]) for i, f in enumerate(self.capture.frame))
        area = shown(drawn, self.recipe.backend)
        density.keep(self.params, self.adam, np.flatnonzero(area >= self.recipe.least_shown * area.mean()))

    def _report(self) -> None:
        steps = self.iteration - (int(self.history[-1][0]) if self.history else 0)
        loss, squared = self.sums / steps
        psnr = -10.0 * math.log10(max(squared, 1e-10))
        self.history.append([float(self.iteration), float(loss), psnr])
        self.sums = np.zeros(2)
        now = time.monotonic()
        rate = (self.iteration - self._clock[0]) / max(now - self._clock[1], 1e-9)
        self._clock = (self.iteration, now)
        text = f"iteration {self.iteration}, {psnr:.1f} dB on training images, {len(self.params['means'])} Gaussians"
        self.workspace.say(f"{text}, {rate:.0f} steps/s", self.iteration / self.recipe.iterations)

    # to and from the disk

    def save(self) -> None:
        """Keeps all that the next steps depend on."""
        tensors = {f"param.{n}": v for n, v in self.learned().items()}
        tensors |= {f"first.{n}": v for n, v in self.adam.first.items()}
        tensors |= {f"second.{n}": v for n, v in self.adam.second.items()}
        tensors |= {f"mean.{n}": v for n, v in self.mean.items()}
        arrays = {"pull.total": self.pull.total, "pull.seen": self.pull.seen, "queue": self.queue, "sums": self.sums}
        if self.deformation is not None:
            tensors["rest"] = self.deformation.rest
        if isinstance(self.deformation, Nodes):
            arrays |= {"centres": self.deformation.centres, "level": self.deformation.level}
            tensors |= {"index": self.deformation.index, "weights": self.deformation.weights}
        tensors |= {n: torch.from_numpy(np.ascontiguousarray(a)) for n, a in arrays.items()}
        rest = {
            "iteration": self.iteration,
            "history": self.history,
            "frames": self.frames,
            "averaged": self.averaged,
            "random": self.rng.bit_generator.state,
        }
        checkpoint.save(self.workspace.folder, tensors, rest)

    def resume(self) -> None:
        """Takes up the state last saved, if there is one."""
        found = checkpoint.load(self.workspace.folder)
        if found is None:
            return
        tensors, rest = found
        groups: dict[str, dict[str, torch.Tensor]] = {"param": {}, "first": {}, "second": {}, "mean": {}}
        for name, tensor in tensors.items():
            kind, _, own = name.partition(".")
            if kind in groups:
                groups[kind][own] = tensor.to(self.device)
        self.params = {n: groups["param"][n] for n in density.NAMES}
        self.adam.first, self.adam.second, self.mean = groups["first"], groups["second"], groups["mean"]
        self.pull.total, self.pull.seen = tensors["pull.total"].numpy(), tensors["pull.seen"].numpy()
        self.queue, self.sums = tensors["queue"].numpy(), tensors["sums"].numpy()
        self.iteration, self.history, self.averaged = rest["iteration"], rest["history"], rest["averaged"]
        self.frames = [tuple(f) for f in rest["frames"]]
        self.rng.bit_generator.state = rest["random"]
        self._clock = (self.iteration, time.monotonic())
        if "rest" in tensors:
            self._resume_deformation(tensors, groups["param"])

    def _resume_deformation(self, tensors: dict[str, torch.Tensor], params: dict[str, torch.Tensor]) -> None:
        recipe = self.recipe
        if recipe.deformation == "nodes":
            centres, level = tensors["centres"].numpy(), tensors["level"].numpy()
            self.deformation = Nodes(self._spline(), centres, level, params["table"].cpu().numpy())
            self.deformation.index, self.deformation.weights = tensors["index"], tensors["weights"]
        else:
            self.deformation = Mlp(self.capture.times, tensors["rest"].numpy(), **self._network())
            self.deformation.layers = {n: v for n, v in params.items() if n not in density.NAMES}
        self.neighbours = Neighbourhood(self.deformation.rest, recipe.neighbours)

    # the result

    def result(self) -> Reconstruction:
        """What was fitted, in the capture's own place and unit."""
        capture, recipe = self.capture, self.recipe
        if self.deformation is None:
            self._set_in_motion()
        learned = self.learned()
        for name, mean in self.mean.items():
            learned[name].data.copy_(mean)
        count, frames = len(self.params["means"]), len(capture.times)
        self.workspace.check_memory(4e-9 * frames * count * (5 if recipe.deltas else 3))
        points = np.empty((frames, count, 3), np.float32)
        scaling, opacity = (np.empty((frames, count), np.float32) if recipe.deltas else None for _ in range(2))
        with torch.no_grad():
            opacities = self.params["opacities"]
            for f in range(frames):
                moved = self.deformation.at(f, self.params["means"])
                points[f] = moved.means.cpu().numpy() * self.unit + self.centre
                if recipe.deltas:
                    scaling[f] = torch.exp(moved.log_scales[:, 0]).cpu().numpy()
                    now = torch.sigmoid(opacities + moved.opacities) / torch.sigmoid(opacities)
                    opacity[f] = now.cpu().numpy()
            rest = {n: v.detach().cpu().numpy() for n, v in self.params.items()}
        gaussians = Gaussians(
            means=(rest["means"] * self.unit + self.centre).astype(np.float32),
            scales=(np.exp(rest["log_scales"]) * self.unit).astype(np.float32),
            quaternions=None,
            opacities=(1.0 / (1.0 + np.exp(-rest["opacities"]))).astype(np.float32),
            sh=rest["sh"],
        )
        return Reconstruction(
            name=capture.name,
            gaussians=gaussians,
            points=points,
            rotations=None,  # isotropic Gaussians have no direction
            scaling=scaling,
            opacity=opacity,
            times=capture.times,
            fps=capture.fps,
            clip_start=capture.clip_start,
            clip_names=capture.clip_names,
            unit=capture.unit,
            rig=capture.rig,
            history=np.array(self.history, np.float64).reshape(-1, 3),
        )
