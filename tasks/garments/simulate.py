"""Cloth over the moving body: Newton's vertex block descent (SolverVBD) on one core, frame by frame.

The body is a collision mesh that is moved and refitted in every substep, with its surface velocities, so that friction
drags the cloth along. Cloth does not collide with itself, nor with hands, nor with the ground.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np

from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Cloth, Motion, Poses
from tasks.workspace import Workspace

WITHOUT = ("LeftHand", "RightHand")  # fingers are finer than the cloth's mesh
FAR = 100.0  # metres: the moving body stays within, so bounds need no update


def collision_faces(body: Motion) -> np.ndarray:
    """Faces of the body that cloth collides with: all but the hands'."""
    hands = [body.rig.names.index(name) for name in WITHOUT]
    loose = body.rig.weights[:, hands].sum(1) > 0.5
    return body.faces[~loose[body.faces].any(1)]


def body_points(body: Motion, poses: Poses) -> np.ndarray:
    """The posed body, (F, V, 3)."""
    rig = body.rig
    return skin(
        body.rest, rig.weights, kinematics.forward(rig.parents, rig.joints, poses.rotations, poses.translations)
    )


def simulate(
    body: Motion,
    garment: Canonical,
    poses: Poses,
    cloth: Cloth | None,
    *,
    first: int,
    fps: float,
    substeps: int,
    iterations: int,
    density: float,
    stretch: float,
    bend: float,
    damping: float,
    contact: float,
    friction: float,
    thickness: float,
    drag: float,
) -> Iterator[Cloth]:
    """The cloth at frames first, first + 1, … of the poses, each as it is done: stop at any time, go on from the last.

    garment: its points are the stress-free shape; cloth: the state at frame first - 1, or None: the garment as cut, at
    rest, at frame `first` itself (which is then given back as it is).
    density: kg/m^2; stretch: N/m, membrane stiffness; bend: N m/rad, of an edge; damping: of stretching, seconds;
    contact: N/m, stiffness of contact; friction: Coulomb's coefficient; thickness: metres that cloth keeps off the
    skin; drag: 1/s, share of its velocity that still air takes from the cloth. Raises InputError where cloth explodes.
    """
    if cloth is None:
        cloth = Cloth(garment.points, np.zeros_like(garment.points))
        yield cloth
        first += 1
    scene = _Scene(
        body,
        garment,
        iterations=iterations,
        density=density,
        stretch=stretch,
        bend=bend,
        damping=damping,
        contact=contact,
        friction=friction,
        thickness=thickness,
    )
    scene.put(cloth)
    step = 1.0 / (fps * substeps)
    window = _Window(body, poses)
    for frame in range(first, len(poses.rotations)):
        before = window.between(frame, 0.0)
        for sub in range(1, substeps + 1):
            now = window.between(frame, sub / substeps)
            scene.step(now, (now - before) / step, step, keep=float(np.exp(-drag * step)))
            before = now
        cloth = scene.get()
        if not np.isfinite(cloth.points).all():
            found = f"cloth that exploded at frame {frame}"
            raise InputError("make.simulate", expected="cloth that stays finite", found=found, do="more substeps")
        yield cloth


def simulate_frames(
    body: Motion,
    garment: Canonical,
    poses: Poses,
    settled: Cloth | None = None,
    *,
    fps: Annotated[float, "(0, inf)"],
    substeps: Annotated[int, "[1, inf)"],
    iterations: Annotated[int, "[1, inf)"],
    density: Annotated[float, "(0, inf)"],
    stretch: Annotated[float, "[0, inf)"],
    bend: Annotated[float, "[0, inf)"],
    damping: Annotated[float, "[0, inf)"],
    contact: Annotated[float, "[0, inf)"],
    friction: Annotated[float, "[0, inf)"],
    thickness: Annotated[float, "(0, inf)"],
    drag: Annotated[float, "[0, inf)"],
    workspace: Workspace,
) -> tuple[Motion, Cloth]:
    """The cloth over all frames of the poses: the frames of their last clip as a motion, and the state after the last.

    settled: the cloth on the standing body, with which the first frame begins, or None: the garment as cut. Settings as
    in :func:`simulate`. Every frame is kept in the workspace as it is done, so that a killed run goes on from there.
    """
    settings = {"density": density, "stretch": stretch, "bend": bend, "damping": damping, "contact": contact}
    settings |= {"friction": friction, "thickness": thickness, "drag": drag, "fps": fps}
    settings |= {"substeps": substeps, "iterations": iterations}
    count = len(poses.rotations)
    states = _kept(workspace.folder, count)
    if settled is not None and not states:
        states = [carried(settled, body, poses)]
        _keep(workspace.folder, 0, states[0])
    if len(states) < count:
        last = states[-1] if states else None
        for state in simulate(body, garment, poses, last, first=len(states), **settings):
            _keep(workspace.folder, len(states), state)
            states.append(state)
            workspace.say(f"frame {len(states)} of {count}", len(states) / count)
    shown = states[int(poses.clip_start[-2]) :]
    points = np.stack([state.points for state in shown])
    name = garment.source.split()[0]
    motion = Motion(name, points, garment.faces, np.array([0, len(points)]), (name,), fps, "m", garment.points)
    return motion, states[-1]


def _keep(folder: Path, frame: int, state: Cloth) -> None:
    """One file a frame, renamed into place whole."""
    draft = folder / "draft.npy"
    np.save(draft, np.stack([state.points, state.velocities]), allow_pickle=False)
    os.replace(draft, folder / f"{frame:05d}.npy")


def _kept(folder: Path, count: int) -> list[Cloth]:
    """The states of the frames that an earlier run has done, from the first on."""
    states = []
    for frame in range(count):
        file = folder / f"{frame:05d}.npy"
        if not file.is_file():
            break
        states.append(Cloth(*np.load(file, allow_pickle=False)))
    return states


def carried(cloth: Cloth, body: Motion, poses: Poses) -> Cloth:
    """The state of cloth on a body that stands still, taken to where the body stands in the first of the poses."""
    turn = poses.rotations[0, 0].astype(np.float64)
    hips = body.rig.joints[0].astype(np.float64)
    place = hips + poses.translations[0, 0]
    points = (cloth.points - hips) @ turn.T + place
    return Cloth(points.astype(np.float32), (cloth.velocities @ turn.T).astype(np.float32))


class _Window:
    """The body between frames: Catmull-Rom through its vertices, so that velocities have no jumps."""

    def __init__(self, body: Motion, poses: Poses) -> None:
        self.body, self.poses, self.kept = body, poses, {}

    def at(self, frame: int) -> np.ndarray:
        frame = min(max(frame, 0), len(self.poses.rotations) - 1)
        if frame not in self.kept:
            one = Poses(
                self.poses.rotations[frame : frame + 1], self.poses.translations[frame : frame + 1], np.array([0, 1])
            )
            self.kept = {f: p for f, p in self.kept.items() if f >= frame - 3} | {
                frame: body_points(self.body, one)[0].astype(np.float64)
            }
        return self.kept[frame]

    def between(self, frame: int, t: float) -> np.ndarray:
        """From frame - 1 (t = 0) to frame (t = 1)."""
        a, b, c, d = (self.at(frame + k) for k in (-2, -1, 0, 1))
        m, n = (c - a) / 2, (d - b) / 2
        return (2 * t**3 - 3 * t**2 + 1) * b + (t**3 - 2 * t**2 + t) * m + (3 * t**2 - 2 * t**3) * c + (t**3 - t**2) * n


class _Scene:
    """Newton's model, solver and states for one garment over one body."""

    def __init__(
        self,
        body: Motion,
        garment: Canonical,
        *,
        iterations: int,
        density: float,
        stretch: float,
        bend: float,
        damping: float,
        contact: float,
        friction: float,
        thickness: float,
    ) -> None:
        import warp as wp

        wp.config.quiet = True  # before anything starts it: it tells of every kernel it loads
        import newton

        self.wp = wp
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -9.81, 0.0))
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0, 0.0, 0.0),
            vertices=[wp.vec3(*map(float, p)) for p in garment.points],
            indices=garment.faces.ravel().tolist(),
            density=density,
            tri_ke=stretch,
            tri_ka=stretch,
            tri_kd=damping * stretch,
            edge_ke=bend,
            edge_kd=0.0,
            particle_radius=thickness,
        )
        self.skin = newton.Mesh(body.rest, collision_faces(body).ravel(), compute_inertia=False)
        builder.add_shape_mesh(-1, mesh=self.skin, cfg=newton.ModelBuilder.ShapeConfig(mu=friction, ke=contact, kd=0.0))
        builder.color(include_bending=True)
        model = builder.finalize(device="cpu")
        model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = contact, 0.0, friction
        model.shape_collision_aabb_lower.fill_(wp.vec3(-FAR, -FAR, -FAR))
        model.shape_collision_aabb_upper.fill_(wp.vec3(FAR, FAR, FAR))
        self.pipeline = newton.CollisionPipeline(model, soft_contact_gap=10 * thickness)
        self.contacts = self.pipeline.contacts()
        self.solver = newton.solvers.SolverVBD(model, iterations=iterations, particle_enable_tile_solve=False)
        self.states = [model.state(), model.state()]
        self.control = model.control()

    def put(self, cloth: Cloth) -> None:
        self.states[0].particle_q.assign(cloth.points.astype(np.float32))
        self.states[0].particle_qd.assign(cloth.velocities.astype(np.float32))

    def get(self) -> Cloth:
        return Cloth(self.states[0].particle_q.numpy().copy(), self.states[0].particle_qd.numpy().copy())

    def step(self, skin_points: np.ndarray, skin_velocities: np.ndarray, seconds: float, keep: float) -> None:
        """One substep with the skin where it is at the substep's end."""
        mesh = self.skin.mesh
        mesh.points.assign(skin_points.astype(np.float32))
        mesh.velocities.assign(skin_velocities.astype(np.float32))
        mesh.refit()
        now, then = self.states
        now.clear_forces()
        self.pipeline.collide(now, self.contacts)
        self.solver.step(now, then, self.control, self.contacts, seconds)
        velocities = then.particle_qd.numpy()  # a view on the CPU
        velocities *= keep
        self.states = [then, now]
