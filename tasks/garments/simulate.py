"""Cloth over the moving body: Newton's vertex block descent (SolverVBD) on one core, frame by frame.

The body is a collision mesh that is moved and refitted in every substep, with its surface velocities, so that friction
drags the cloth along. Cloth does not collide with itself, nor with hands, nor with the ground.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tasks.geometry import kinematics
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Motion, Poses

WITHOUT = ("LeftHand", "RightHand")  # fingers are finer than the cloth's mesh
FAR = 100.0  # metres: the moving body stays within, so bounds need no update


@dataclass(frozen=True)
class Cloth:
    """The state between two frames. points: (N, 3) metres; velocities: (N, 3) metres a second."""

    points: np.ndarray
    velocities: np.ndarray


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
    skin; drag: 1/s, share of its velocity that still air takes from the cloth.
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
            raise FloatingPointError(f"the cloth exploded at frame {frame}")
        yield cloth


def simulate_chunk(
    body: Motion,
    garment: Canonical,
    poses: Poses,
    cloth: Cloth | None,
    *,
    first: int,
    count: int,
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
) -> tuple[Motion, Cloth]:
    """`count` frames from `first` on as a motion of the cloth, and the state after the last, for a cached stage.

    cloth: the state at frame first - 1, or None: the garment as cut; settings as in :func:`simulate`.
    """
    settings = {"density": density, "stretch": stretch, "bend": bend, "damping": damping, "contact": contact}
    settings |= {"friction": friction, "thickness": thickness, "drag": drag}
    stepping = simulate(
        body, garment, poses, cloth, first=first, fps=fps, substeps=substeps, iterations=iterations, **settings
    )
    done = [cloth for _, cloth in zip(range(count), stepping, strict=False)]
    points = np.stack([state.points for state in done])
    name = garment.source.split()[0]
    return Motion(name, points, garment.faces, np.array([0, len(points)]), (name,), fps, "m", garment.points), done[-1]


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
        import newton
        import warp as wp

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
