"""The figure: a dancer in a skirt who walks, runs, twists, squats, waves, kicks, spins and dances."""

from __future__ import annotations

import numpy as np

from tasks.datasets.creature_motion import (
    TAU,
    Path,
    Puppet,
    about,
    bump,
    carry,
    cyclic,
    ease,
    footfalls,
    mirrored,
    offset,
    raised,
    rise,
    standing,
    straight,
)  # fmt: skip
from tasks.datasets.creature_shape import Bell, Cone
from tasks.datasets.creature_soft import Cloth, Lobe, Pad

# joint: (parent, rest position); the figure looks along +z, its left is +x, arms half lowered
_SPINE = {
    "pelvis": (None, (0.0, 0.97, 0.0)),
    "spine": ("pelvis", (0.0, 1.09, -0.005)),
    "chest": ("spine", (0.0, 1.22, -0.01)),
    "neck": ("chest", (0.0, 1.43, -0.015)),
    "head": ("neck", (0.0, 1.52, 0.0)),
}
_SIDE = {
    "upper_arm": ("chest", (0.165, 1.375, -0.015)),
    "forearm": ("upper_arm", (0.36, 1.18, -0.02)),
    "hand": ("forearm", (0.535, 1.005, 0.0)),
    "thigh": ("pelvis", (0.09, 0.91, 0.0)),
    "shin": ("thigh", (0.10, 0.50, 0.022)),
    "foot": ("shin", (0.105, 0.085, -0.025)),
}
BALL = (0.11, 0.0, 0.09)
ELBOW = {"l": (-1.0, -1.0, 0.0), "r": (-1.0, 1.0, 0.0)}  # positive turns bend the elbow forward
SKIRT = Bell("pelvis", ((0.12, 1.05), (0.175, 0.97), (0.24, 0.86), (0.30, 0.72), (0.35, 0.56)), 0.026, 0.92, 0.03)


def joints() -> dict[str, tuple[str | None, tuple[float, float, float]]]:
    """Joint -> (parent, rest position), parents first."""
    tree = dict(_SPINE)
    for side in "lr":
        for name, (parent, at) in _SIDE.items():
            tree[f"{name}_{side}"] = (parent if parent in _SPINE else f"{parent}_{side}", mirrored(at, side))
    return tree


def parts() -> list[Cone | Bell]:
    """The body, trunk first, the skirt last."""
    body: list[Cone | Bell] = [
        Cone("pelvis", (0, 0.93, -0.01), (0, 1.02, -0.005), 0.15, 0.125, 0.05, (1, 1, 0.85)),
        Cone("spine", (0, 1.085, -0.005), (0, 1.175, -0.005), 0.115, 0.12, 0.06, (1, 1, 0.8)),
        Cone("chest", (0, 1.23, -0.01), (0, 1.30, -0.015), 0.13, 0.135, 0.07, (1, 1, 0.75)),
        Cone("chest", (-0.10, 1.375, -0.015), (0.10, 1.375, -0.015), 0.065, 0.065, 0.06),
        Cone("neck", (0, 1.41, -0.015), (0, 1.52, 0.0), 0.051, 0.048, 0.04),
        Cone("head", (0, 1.60, -0.005), (0, 1.645, -0.005), 0.092, 0.095, 0.03, (0.88, 1, 1.05)),
        Cone("head", (0, 1.555, 0.045), (0, 1.56, 0.05), 0.05, 0.05, 0.05),
        Cone("head", (0, 1.60, 0.095), (0, 1.585, 0.105), 0.02, 0.022, 0.03),
        Cone("head", (0, 1.66, -0.09), (0, 1.645, -0.16), 0.045, 0.04, 0.03),
        Cone("head", (0, 1.645, -0.16), (0, 1.50, -0.225), 0.04, 0.05, 0.03),
        Cone("head", (0, 1.50, -0.225), (0, 1.30, -0.225), 0.05, 0.022, 0.03),
        Cone("chest", (0.05, 1.27, 0.055), (0.06, 1.265, 0.055), 0.065, 0.06, 0.08),
        Cone("chest", (-0.05, 1.27, 0.055), (-0.06, 1.265, 0.055), 0.065, 0.06, 0.08),
    ]
    for side in "lr":

        def at(x: float, y: float, z: float, side: str = side) -> tuple[float, float, float]:
            return mirrored((x, y, z), side)

        body += [
            Cone(f"upper_arm_{side}", at(0.165, 1.37, -0.015), at(0.36, 1.18, -0.02), 0.058, 0.04, 0.04),
            Cone(f"forearm_{side}", at(0.36, 1.18, -0.02), at(0.535, 1.005, 0.0), 0.041, 0.03, 0.02),
            Cone(f"hand_{side}", at(0.55, 0.99, 0.0), at(0.605, 0.925, 0.008), 0.036, 0.034, 0.03, (1, 1, 0.9)),
            Cone(f"hand_{side}", at(0.605, 0.925, 0.008), at(0.64, 0.875, 0.012), 0.032, 0.03, 0.02),
            Cone(f"thigh_{side}", at(0.085, 0.90, -0.005), at(0.10, 0.52, 0.02), 0.088, 0.058, 0.03),
            Cone(f"shin_{side}", at(0.10, 0.50, 0.02), at(0.103, 0.36, -0.01), 0.055, 0.055, 0.03),
            Cone(f"shin_{side}", at(0.103, 0.36, -0.01), at(0.105, 0.10, -0.025), 0.055, 0.038, 0.03),
            Cone(f"foot_{side}", at(0.105, 0.05, -0.045), at(0.11, 0.038, 0.07), 0.042, 0.038, 0.03),
            Cone(f"foot_{side}", at(0.11, 0.036, 0.07), at(0.112, 0.03, 0.145), 0.038, 0.028, 0.02),
        ]
    return [*body, SKIRT]


def soft() -> list[Lobe | Pad | Cloth]:
    """Skirt, pony tail and chest."""
    body = parts()
    torso = tuple(i for i, p in enumerate(body) if p.joint == "chest")
    hair = ((0, 1.64, -0.165), (0, 1.50, -0.225), (0, 1.29, -0.225))
    legs = tuple(f"{n}_{side}" for n in ("thigh", "shin") for side in "lr")
    return [
        Cloth(len(body) - 1, 32, 9, 0.9, 3.0, 0.3, 0.35, legs),
        Lobe((9, 10), hair, 8, 1.0, 5.0, 1.5, 0.12, 0.25, True, ("chest", "neck")),
        Pad(torso, (0, 1.27, 0.13), (0.14, 0.10, 0.10), 2.4, 6.0, 0.2, 0.04, 0.045),
    ]


def drape(weights: np.ndarray, vertices: np.ndarray, body: list, names: tuple[str, ...]) -> np.ndarray:
    """Hangs the skirt on the pelvis, its hem by a third on the thigh of its side. weights: (N, J) -> (N, J)."""
    nearest = np.stack([p.distance(vertices) for p in body]).argmin(0)
    skirt = nearest == len(body) - 1
    side = 1.0 / (1.0 + np.exp(-vertices[:, 0] / 0.06))
    share = 0.35 * ease(SKIRT.along(vertices) * 1.2 - 0.2)
    hung = np.zeros_like(weights)
    hung[:, names.index("pelvis")] = 1.0 - share
    hung[:, names.index("thigh_l")], hung[:, names.index("thigh_r")] = share * side, share * (1.0 - side)
    return np.where(skirt[:, None], hung, weights)


def leg(
    p: Puppet, side: str, target: np.ndarray, heading: np.ndarray, pitch: np.ndarray, out: float = 0.0
) -> None:  # fmt: skip
    """Brings the ball of a foot to the target; pitch lifts the heel; out: toes and knee outwards, radians."""
    sign = 1.0 if side == "l" else -1.0
    chain = (f"thigh_{side}", f"shin_{side}", f"foot_{side}")
    sole = about("y", heading + sign * out) @ about("x", pitch)
    pole = np.array([sign * np.sin(out), 0.0, np.cos(out)])
    p.reach(chain, np.array(mirrored(BALL, side)), target, sole, pole)


def stand_on(p: Puppet, t: np.ndarray, heel: np.ndarray | float = 0.0) -> None:
    """Both feet where they are at rest."""
    for side in "lr":
        leg(p, side, np.tile(mirrored(BALL, side), (len(t), 1)), 0.0 * t, heel + 0.0 * t)


def step(
    p: Puppet, t: np.ndarray, path: Path, heading: np.ndarray, *, period: float, duty: float, lift: float, heel: float
) -> None:
    """Moves both legs in a gait, the left foot coming down at the start of a cycle."""
    for side, phase in (("l", 0.0), ("r", 0.5)):
        home = np.array(mirrored(BALL, side)) * (0.8, 1.0, 1.0)
        target, u = footfalls(t, path, home, phase=phase, period=period, duty=duty, lift=lift)
        swing = 0.5 * (1.0 + duty)
        pitch = cyclic(
            u, (0.0, -0.22), (0.2 * duty, 0.0), (0.6 * duty, 0.05), (duty, heel), (swing, 0.5 * heel),
            (0.4 * swing + 0.6, -0.2),
        )  # fmt: skip
        leg(p, side, raised(target, pitch, 0.06, 0.4), heading, pitch)


def arms(p: Puppet, *, swing: np.ndarray | float = 0.0, lower: float = 0.45, elbow: np.ndarray | float = 0.3) -> None:
    """Arms hanging and swinging against each other; swing > 0: left arm back, right arm forward."""
    for side, sign in (("l", 1.0), ("r", -1.0)):
        p.turn(f"upper_arm_{side}", ("x", sign * np.asarray(swing)), ("z", -sign * lower))
        p.turn(f"forearm_{side}", (ELBOW[side], elbow - 0.5 * sign * np.asarray(swing)))


def walk(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Walk with swinging arms and hips."""
    period, path = 1.05, straight(0.95)
    a = TAU * t / period
    shift = offset(0.022 * np.sin(a + 0.3), -0.03 - 0.016 * np.cos(2 * a - 0.4), 0.0)
    turns = [("y", -0.13 * gain * np.cos(a)), ("z", -0.045 * np.sin(a)), ("x", 0.04)]
    heading = carry(p, t, path, shift=shift, turns=turns)
    p.turn("spine", ("y", 0.12 * gain * np.cos(a)), ("z", 0.05 * np.sin(a)))
    p.turn("chest", ("y", 0.14 * gain * np.cos(a)))
    p.turn("head", ("y", -0.12 * gain * np.cos(a)), ("x", 0.03 * np.cos(2 * a)))
    arms(p, swing=0.45 * gain * np.cos(a))
    step(p, t, path, heading, period=period, duty=0.6, lift=0.05, heel=0.75)


def run(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Run, leaning forward, elbows bent."""
    period, path = 0.72, straight(2.1)
    a = TAU * t / period
    shift = offset(0.01 * np.sin(a), -0.06 + 0.03 * gain * np.cos(2 * a - 2.6), 0.0)
    heading = carry(p, t, path, shift=shift, turns=[("y", -0.16 * gain * np.cos(a)), ("x", 0.14)])
    p.turn("spine", ("y", 0.2 * gain * np.cos(a)), ("x", 0.05))
    p.turn("chest", ("y", 0.16 * gain * np.cos(a)))
    p.turn("head", ("y", -0.18 * gain * np.cos(a)), ("x", -0.12))
    arms(p, swing=0.75 * gain * np.cos(a), lower=0.4, elbow=1.45)
    step(p, t, path, heading, period=period, duty=0.36, lift=0.17, heel=1.0)


def twist(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Twists hips and shoulders to and fro, arms out."""
    on = rise(t / span, 0.0, 0.15) * (1.0 - rise(t / span, 0.85, 1.0))
    yaw = 0.55 * gain * on * np.sin(TAU * 0.85 * t)
    carry(p, t, standing, shift=offset(0.0, -0.035 * on, 0.0), turns=[("y", yaw)])
    p.turn("spine", ("y", 0.4 * yaw))
    p.turn("chest", ("y", 0.5 * yaw))
    p.turn("head", ("y", -0.8 * yaw))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        p.turn(f"upper_arm_{side}", ("z", sign * 0.55 * on))
        p.turn(f"forearm_{side}", (ELBOW[side], 0.35 * on))
    stand_on(p, t)


def squat(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Two knee bends, the second deeper, arms forward."""
    s = t / span
    down = 0.75 * bump(s, 0.02, 0.24, 0.48) + bump(s, 0.48, 0.72, 0.98)
    drop = 0.36 * gain * down
    carry(p, t, standing, shift=offset(0.0, -drop, -0.20 * down), turns=[("x", 0.45 * down)])
    p.turn("spine", ("x", 0.10 * down))
    p.turn("head", ("x", -0.45 * down))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        p.turn(f"upper_arm_{side}", ("x", -1.55 * down), ("y", sign * 0.3 * down), ("z", -sign * 0.45 * (1 - down)))
        p.turn(f"forearm_{side}", (ELBOW[side], 0.25))
    for side in "lr":
        leg(p, side, np.tile(mirrored(BALL, side), (len(t), 1)), 0.0 * t, 0.12 * down, 0.25)


def wave(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Stands on one hip and waves with the left arm."""
    s = t / span
    up = rise(s, 0.02, 0.25) * (1.0 - rise(s, 0.8, 1.0))
    lean = rise(s, 0.0, 0.3) * (1.0 - rise(s, 0.75, 1.0))
    beat = up * np.sin(TAU * 1.8 * t)
    carry(p, t, standing, shift=offset(-0.04 * lean, -0.012 * lean, 0.0), turns=[("z", -0.07 * lean)])
    p.turn("spine", ("z", 0.08 * lean))
    p.turn("chest", ("z", 0.05 * lean + 0.03 * beat), ("y", 0.08 * up))
    p.turn("head", ("z", 0.10 * lean), ("y", 0.2 * up))
    p.turn("upper_arm_l", ("x", -0.25 * up), ("z", 1.25 * gain * up - 0.45 * (1 - up)))
    p.turn("forearm_l", ("z", 0.9 * up + 0.45 * beat), (ELBOW["l"], 0.3))
    p.turn("hand_l", ("z", 0.25 * up * np.sin(TAU * 1.8 * t - 0.8)))
    p.turn("upper_arm_r", ("x", 0.1 * up), ("z", 0.45))
    p.turn("forearm_r", (ELBOW["r"], 0.3 + 0.4 * up))
    stand_on(p, t)


def kick(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Steps back, kicks high to the front with the right leg, and sets it down."""
    s = t / span
    load_, strike = bump(s, 0.05, 0.25, 0.42), bump(s, 0.28, 0.46, 0.72)
    turns = [("x", 0.10 * load_ - 0.18 * strike), ("y", -0.25 * load_ + 0.3 * strike)]
    carry(p, t, standing, shift=offset(0.06 * (load_ + strike), -0.05 * load_ - 0.03 * strike, 0.0), turns=turns)
    p.turn("spine", ("x", 0.12 * strike), ("y", 0.2 * load_ - 0.25 * strike))
    p.turn("chest", ("y", 0.2 * load_ - 0.25 * strike), ("x", 0.1 * strike))
    p.turn("head", ("y", -0.1 * load_ + 0.15 * strike))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        fore = -sign * (0.5 * load_ - 0.7 * strike)
        p.turn(f"upper_arm_{side}", ("x", fore), ("z", -sign * (0.45 - 0.5 * (load_ + strike))))
        p.turn(f"forearm_{side}", (ELBOW[side], 0.3 + 0.5 * (load_ + strike)))
    leg(p, "l", np.tile(mirrored(BALL, "l"), (len(t), 1)), 0.0 * t, 0.0 * t, 0.15)
    back = offset(0.0, 0.05 * bump(s, 0.02, 0.14, 0.25), -0.3) * load_[:, None]
    high = offset(0.04, 0.85 * gain, 0.72) * strike[:, None]
    pitch = 0.7 * load_ - 1.1 * strike
    leg(p, "r", np.array(mirrored(BALL, "r")) + back + high, 0.0 * t, pitch)


def spin(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """A full turn on the spot in small steps, arms opening and closing."""

    def path(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return offset(0.0 * np.asarray(time), 0.0, 0.0), TAU * ease((time / span - 0.1) / 0.72)

    s = t / span
    open_ = bump(s, 0.0, 0.18, 0.45) + bump(s, 0.6, 0.8, 1.0)
    closed = bump(s, 0.2, 0.45, 0.75)
    heading = carry(p, t, path, shift=offset(0.0, -0.04 + 0.03 * closed, 0.0), turns=[("y", 0.12 * open_)])
    p.turn("spine", ("y", 0.15 * open_))
    p.turn("chest", ("y", 0.15 * open_), ("x", -0.06 * closed))
    p.turn("head", ("y", 0.3 * bump(s, 0.1, 0.3, 0.5)))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        p.turn(f"upper_arm_{side}", ("x", -0.9 * closed), ("z", sign * (0.85 * gain * open_ - 0.3 * (1 - open_))))
        p.turn(f"forearm_{side}", (ELBOW[side], 0.3 + 1.2 * closed))
    step(p, t, path, heading, period=0.5, duty=0.55, lift=0.05, heel=0.35)


def dance(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Side steps with swaying hips, half turns and arms over the head."""
    period = 1.0

    def path(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        time = np.asarray(time)
        return offset(0.22 * np.sin(TAU * time / (2 * period)), 0.0, 0.0), 0.5 * np.sin(TAU * time / (2 * period) + 1.0)

    a = TAU * t / period
    shift = offset(0.04 * np.sin(a), -0.05 + 0.025 * np.cos(2 * a), 0.0)
    turns = [("z", -0.12 * gain * np.sin(a)), ("y", 0.15 * np.sin(a + 0.8))]
    heading = carry(p, t, path, shift=shift, turns=turns)
    p.turn("spine", ("z", 0.14 * gain * np.sin(a)), ("y", -0.1 * np.sin(a)))
    p.turn("chest", ("z", 0.08 * np.sin(a - 0.5)), ("y", -0.12 * np.sin(a)))
    p.turn("head", ("z", -0.12 * np.sin(a - 0.4)), ("x", 0.05 * np.cos(2 * a)))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        up = 0.5 + 0.5 * np.sin(0.5 * a + 1.2 * sign)
        p.turn(f"upper_arm_{side}", ("x", -0.5 * (1 - up)), ("z", sign * (1.5 * gain * up - 0.2)))
        p.turn(f"forearm_{side}", ("z", sign * 0.5 * up), (ELBOW[side], 0.6 + 0.4 * np.cos(a + sign)))
    step(p, t, path, heading, period=period, duty=0.58, lift=0.07, heel=0.6)


# clip -> (length as a factor on frames_per_clip, the function that poses it)
CLIPS = {
    "walk": (1.1, walk),
    "run": (0.9, run),
    "twist": (1.1, twist),
    "squat": (1.4, squat),
    "wave": (1.2, wave),
    "kick": (1.0, kick),
    "spin": (1.2, spin),
    "dance": (1.5, dance),
}
