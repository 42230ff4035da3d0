"""The animal: a fox-like quadruped that walks, trots, gallops, turns, looks round, wags, sits, shakes and jumps."""

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
from tasks.datasets.creature_shape import Cone
from tasks.datasets.creature_soft import Lobe, Pad

# joint: (parent, rest position); the animal looks along +z, its left is +x
_SPINE = {
    "pelvis": (None, (0.0, 0.62, -0.30)),
    "spine": ("pelvis", (0.0, 0.645, -0.08)),
    "chest": ("spine", (0.0, 0.635, 0.14)),
    "neck": ("chest", (0.0, 0.69, 0.30)),
    "head": ("neck", (0.0, 0.89, 0.43)),
    "tail_1": ("pelvis", (0.0, 0.66, -0.42)),
    "tail_2": ("tail_1", (0.0, 0.65, -0.58)),
    "tail_3": ("tail_2", (0.0, 0.67, -0.74)),
}
_SIDE = {
    "ear": ("head", (0.055, 0.965, 0.42)),
    "upper_arm": ("chest", (0.095, 0.55, 0.24)),
    "forearm": ("upper_arm", (0.10, 0.365, 0.10)),
    "fore_paw": ("forearm", (0.10, 0.15, 0.18)),
    "thigh": ("pelvis", (0.095, 0.57, -0.32)),
    "shin": ("thigh", (0.11, 0.36, -0.22)),
    "hind_paw": ("shin", (0.11, 0.17, -0.40)),
}
FORE_TIP, HIND_TIP = (0.10, 0.0, 0.22), (0.11, 0.0, -0.32)


def joints() -> dict[str, tuple[str | None, tuple[float, float, float]]]:
    """Joint -> (parent, rest position), parents first."""
    tree = dict(_SPINE)
    for side in "lr":
        for name, (parent, at) in _SIDE.items():
            tree[f"{name}_{side}"] = (parent if parent in _SPINE else f"{parent}_{side}", mirrored(at, side))
    return tree


def parts() -> list[Cone]:
    """The body, trunk first."""
    body = [
        Cone("pelvis", (0, 0.61, -0.33), (0, 0.62, -0.20), 0.125, 0.125, 0.05, (0.9, 1, 1)),
        Cone("spine", (0, 0.62, -0.18), (0, 0.62, 0.02), 0.12, 0.13, 0.08, (0.9, 1, 1)),
        Cone("chest", (0, 0.61, 0.04), (0, 0.61, 0.22), 0.135, 0.13, 0.08, (0.9, 1, 1)),
        Cone("chest", (0, 0.54, 0.08), (0, 0.53, 0.24), 0.115, 0.10, 0.08, (0.9, 1, 1)),
        Cone("spine", (0, 0.545, -0.16), (0, 0.53, 0.02), 0.105, 0.115, 0.06),
        Cone("neck", (0, 0.66, 0.25), (0, 0.85, 0.41), 0.11, 0.07, 0.09),
        Cone("head", (0, 0.915, 0.43), (0, 0.91, 0.48), 0.082, 0.075, 0.06),
        Cone("head", (0, 0.89, 0.50), (0, 0.86, 0.645), 0.058, 0.03, 0.05),
        Cone("tail_1", (0, 0.655, -0.42), (0, 0.65, -0.58), 0.04, 0.045, 0.06),
        Cone("tail_2", (0, 0.65, -0.58), (0, 0.67, -0.74), 0.045, 0.06, 0.03),
        Cone("tail_3", (0, 0.67, -0.74), (0, 0.72, -0.96), 0.06, 0.025, 0.03),
    ]
    for side in "lr":

        def at(x: float, y: float, z: float, side: str = side) -> tuple[float, float, float]:
            return mirrored((x, y, z), side)

        body += [
            Cone(f"ear_{side}", at(0.05, 0.965, 0.42), at(0.125, 1.155, 0.38), 0.052, 0.02, 0.04, (1, 1, 0.6)),
            Cone(f"upper_arm_{side}", at(0.085, 0.56, 0.22), at(0.10, 0.365, 0.10), 0.085, 0.052, 0.06),
            Cone(f"forearm_{side}", at(0.10, 0.365, 0.10), at(0.10, 0.15, 0.18), 0.05, 0.034, 0.03),
            Cone(f"fore_paw_{side}", at(0.10, 0.15, 0.18), at(0.10, 0.045, 0.19), 0.033, 0.033, 0.02),
            Cone(f"fore_paw_{side}", at(0.10, 0.036, 0.185), at(0.10, 0.032, 0.245), 0.037, 0.033, 0.03),
            Cone(f"thigh_{side}", at(0.08, 0.57, -0.32), at(0.11, 0.37, -0.23), 0.105, 0.06, 0.06),
            Cone(f"shin_{side}", at(0.11, 0.36, -0.22), at(0.11, 0.17, -0.40), 0.055, 0.034, 0.03),
            Cone(f"hind_paw_{side}", at(0.11, 0.17, -0.40), at(0.11, 0.045, -0.36), 0.034, 0.033, 0.02),
            Cone(f"hind_paw_{side}", at(0.11, 0.036, -0.36), at(0.11, 0.032, -0.295), 0.037, 0.033, 0.03),
        ]
    return body


def soft() -> list[Lobe | Pad]:
    """Belly, ears and tail."""
    body = parts()
    ears = [[i for i, p in enumerate(body) if p.joint == f"ear_{side}"] for side in "lr"]
    tail = tuple(i for i, p in enumerate(body) if p.joint.startswith("tail"))
    trunk = tuple(i for i, p in enumerate(body) if p.joint in ("spine", "chest", "pelvis"))
    back = ((0, 0.655, -0.47), (0, 0.65, -0.58), (0, 0.67, -0.74), (0, 0.715, -0.95))
    lobes: list[Lobe | Pad] = [
        Pad(trunk, (0, 0.46, -0.07), (0.17, 0.15, 0.26), 1.7, 5.0, 0.15, 0.06, 0.06),
        Lobe(tail, back, 9, 1.7, 6.0, 3.5, 0.3, 0.2),
    ]
    for side, own in zip("lr", ears, strict=True):
        axis = (mirrored((0.055, 0.98, 0.42), side), mirrored((0.125, 1.155, 0.38), side))
        lobes.append(Lobe(tuple(own), axis, 7, 2.4, 8.0, 4.5, 0.2, 0.07))
    return lobes


def leg(p: Puppet, which: str, side: str, target: np.ndarray, heading: np.ndarray, pitch: np.ndarray) -> None:
    """Brings a "fore" or "hind" paw to the target, its last bone leaned forward by ``pitch``."""
    fore = which == "fore"
    chain = ("upper_arm", "forearm", "fore_paw") if fore else ("thigh", "shin", "hind_paw")
    tip = np.array(mirrored(FORE_TIP if fore else HIND_TIP, side))
    pole = np.array([0.0, 0.0, -1.0 if fore else 1.0])
    sole = about("y", heading) @ about("x", pitch)
    p.reach(tuple(f"{c}_{side}" for c in chain), tip, target, sole, pole)


def stand_on(p: Puppet, t: np.ndarray, lean: dict[str, np.ndarray] | None = None) -> None:
    """All four paws where they are at rest."""
    for which, tip in (("fore", FORE_TIP), ("hind", HIND_TIP)):
        for side in "lr":
            pitch = 0.0 * t if lean is None else lean[which]
            target = np.tile(mirrored(tip, side), (len(t), 1))
            leg(p, which, side, raised(target, pitch, 0.08, 0.1), 0.0 * t, pitch)


def step(
    p: Puppet, t: np.ndarray, path: Path, heading: np.ndarray, phases: dict[str, float], period: float, duty: float,
    lift: float, fold: float,
) -> None:  # fmt: skip
    """Moves the legs in a gait. phases: "fore_l" … -> when in the cycle the paw comes down; fold: bend in the swing."""
    for paw, phase in phases.items():
        which, side = paw.split("_")
        home = np.array(mirrored(FORE_TIP if which == "fore" else HIND_TIP, side))
        target, u = footfalls(t, path, home, phase=phase, period=period, duty=duty, lift=lift)
        swing = 0.5 * (1.0 + duty)
        pitch = cyclic(u, (0.0, -0.2), (0.5 * duty, 0.05), (duty, 0.5), (swing, fold), (0.5 + 0.5 * swing, 0.1))
        leg(p, which, side, raised(target, pitch, 0.08, 0.08), heading, pitch)


def walk(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Four-beat walk."""
    period, path = 1.0, straight(0.8)
    a = TAU * t / period
    shift = offset(0.015 * np.sin(a), -0.025 + 0.012 * np.cos(2 * a), 0.0)
    heading = carry(p, t, path, shift=shift, turns=[("y", 0.06 * gain * np.sin(a)), ("z", 0.04 * np.sin(a + 0.6))])
    p.turn("spine", ("y", -0.07 * gain * np.sin(a)))
    p.turn("chest", ("y", -0.05 * gain * np.sin(a)), ("z", -0.05 * np.sin(a)))
    p.turn("neck", ("x", 0.12 + 0.06 * gain * np.cos(2 * a + 0.5)), ("y", 0.05 * np.sin(a)))
    p.turn("head", ("x", -0.05 * gain * np.cos(2 * a + 0.2)))
    tail(p, 0.25, 0.18 * gain * np.sin(a + 1.0), lag=0.25)
    step(p, t, path, heading, {"hind_l": 0.0, "fore_l": 0.25, "hind_r": 0.5, "fore_r": 0.75}, period, 0.64, 0.07, 0.7)


def tail(p: Puppet, down: np.ndarray | float, yaw: np.ndarray | float, lag: float = 0.0) -> None:
    """Tail lowered by ``down`` and turned by ``yaw`` in all, shared by its joints."""
    for j, share in (("tail_1", 0.45), ("tail_2", 0.3), ("tail_3", 0.25)):
        p.turn(j, ("y", share * np.asarray(yaw)), ("x", -share * np.asarray(down)))


def trot(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Trot: diagonal legs together, the body bouncing twice a cycle."""
    period, path = 0.56, straight(1.5)
    a = TAU * t / period
    shift = offset(0.0, -0.03 + 0.028 * gain * np.cos(2 * a - 0.4), 0.0)
    heading = carry(p, t, path, shift=shift, turns=[("y", 0.05 * np.sin(a)), ("x", 0.02 * np.sin(2 * a))])
    p.turn("spine", ("y", -0.06 * np.sin(a)))
    p.turn("chest", ("y", -0.04 * np.sin(a)))
    p.turn("neck", ("x", 0.05 + 0.05 * gain * np.cos(2 * a)))
    p.turn("head", ("x", -0.06 * gain * np.cos(2 * a)))
    tail(p, -0.1 + 0.1 * np.cos(2 * a), 0.12 * np.sin(a))
    step(p, t, path, heading, {"hind_l": 0.0, "fore_r": 0.0, "hind_r": 0.5, "fore_l": 0.5}, period, 0.45, 0.11, 1.0)


def gallop(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Rotary gallop: the back rounds as the hind legs come under, stretches as they push."""
    period, path = 0.5, straight(2.9)
    a = TAU * t / period
    curl = gain * np.cos(a - 0.2)
    shift = offset(0.0, -0.03 + 0.045 * gain * np.sin(a - 1.9), 0.02 * curl)
    heading = carry(p, t, path, shift=shift, turns=[("x", -0.22 * curl + 0.10 * np.sin(a))])
    p.turn("spine", ("x", 0.22 * curl))
    p.turn("chest", ("x", 0.10 * curl - 0.08 * np.sin(a)))
    p.turn("neck", ("x", 0.30 - 0.14 * curl))
    p.turn("head", ("x", -0.28 + 0.10 * curl))
    tail(p, -0.3 + 0.25 * np.cos(a - 0.8), 0.06 * np.sin(a))
    step(p, t, path, heading, {"hind_l": 0.0, "hind_r": 0.10, "fore_r": 0.47, "fore_l": 0.58}, period, 0.28, 0.13, 1.1)


def turn(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Walk round a bend to the left, head and spine into it."""
    period, speed, radius = 0.9, 0.75, 0.75

    def path(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = speed / radius * np.asarray(time)
        return offset(radius * (1 - np.cos(angle)), 0.0, radius * np.sin(angle)), angle

    a = TAU * t / period
    shift = offset(0.01 * np.sin(a), -0.03 + 0.012 * np.cos(2 * a), 0.0)
    heading = carry(p, t, path, shift=shift, turns=[("y", -0.12 + 0.05 * np.sin(a)), ("z", -0.06)])
    for name, share in (("spine", 0.16), ("chest", 0.16), ("neck", 0.3), ("head", 0.2)):
        p.turn(name, ("y", share * gain))
    p.turn("neck", ("x", 0.15 + 0.05 * np.cos(2 * a)))
    tail(p, 0.2, -0.35 + 0.15 * np.sin(a))
    step(p, t, path, heading, {"hind_l": 0.0, "fore_l": 0.25, "hind_r": 0.5, "fore_r": 0.75}, period, 0.62, 0.07, 0.7)


def look(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Stands and looks left, right and up, ears turning after."""
    s = t / span
    yaw = gain * (0.55 * bump(s, 0.03, 0.2, 0.42) - 0.65 * bump(s, 0.33, 0.52, 0.74))
    up = gain * 0.45 * bump(s, 0.66, 0.8, 0.98)
    carry(p, t, standing, shift=offset(-0.015 * yaw, 0.0, 0.0), turns=[("y", 0.05 * yaw)])
    p.turn("chest", ("y", 0.12 * yaw))
    p.turn("neck", ("y", 0.6 * yaw), ("x", -0.4 * up))
    p.turn("head", ("y", 0.7 * yaw), ("x", -0.8 * up), ("z", -0.25 * yaw))
    flick = bump(s, 0.2, 0.24, 0.30) + bump(s, 0.56, 0.60, 0.66) + bump(s, 0.8, 0.84, 0.9)
    p.turn("ear_l", ("x", 0.35 * flick), ("z", -0.3 * flick))
    p.turn("ear_r", ("x", 0.2 * flick - 0.3 * up), ("z", 0.3 * flick))
    tail(p, 0.3 - 0.5 * up, 0.25 * yaw)
    stand_on(p, t)


def wag(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Play bow: front down, rump up, tail wagging fast."""
    s = t / span
    bow = rise(s, 0.02, 0.25) * (1.0 - rise(s, 0.8, 0.99))
    swing = np.sin(TAU * 1.9 * t) * rise(s, 0.0, 0.15) * (1.0 - rise(s, 0.88, 1.0))
    turns = [("y", 0.07 * swing), ("x", 0.42 * bow), ("z", 0.05 * swing)]
    carry(p, t, standing, shift=offset(-0.02 * swing, -0.03 * bow, -0.13 * bow), turns=turns)
    p.turn("spine", ("x", 0.06 * bow), ("y", -0.08 * swing))
    p.turn("neck", ("x", -0.55 * bow))
    p.turn("head", ("x", 0.1 * bow), ("z", 0.1 * swing))
    tail(p, -0.7 * bow, 1.2 * gain * swing)
    stand_on(p, t, {"fore": -0.5 * bow, "hind": 0.15 * bow})


def sit(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Sits down, gives the right paw, and gets up again."""
    s = t / span
    down = rise(s, 0.02, 0.28) * (1.0 - rise(s, 0.8, 0.99))
    give = bump(s, 0.34, 0.52, 0.76)
    turns = [("x", -0.72 * down), ("z", -0.06 * give)]
    carry(p, t, standing, shift=offset(0.02 * give, -0.37 * down, 0.04 * down), turns=turns)
    p.turn("spine", ("x", 0.05 * down))
    p.turn("chest", ("x", 0.1 * down))
    p.turn("neck", ("x", 0.25 * down), ("y", 0.15 * give))
    p.turn("head", ("x", 0.25 * down), ("z", 0.2 * give))
    tail(p, 0.2 - 0.75 * down, 0.3 * np.sin(TAU * 1.3 * t) * down)
    for side in "lr":
        hind = np.array(mirrored(HIND_TIP, side)) + offset(0.02 * down * (1 if side == "l" else -1), 0.0, 0.2 * down)
        leg(p, "hind", side, raised(hind, -0.85 * down, 0.08, 0.08), 0.0 * t, -0.85 * down)
        lifted = give * gain if side == "r" else 0.0 * t
        fore = np.array(mirrored(FORE_TIP, side)) + offset(0.0, 0.3 * lifted, 0.16 * lifted)
        leg(p, "fore", side, fore, 0.0 * t, 0.5 * lifted * (1 - lifted) * 4 - 0.3 * lifted)


def shake(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Shakes itself from head to tail, the twist running backwards."""
    s = t / span
    on = rise(s, 0.05, 0.3) * (1.0 - rise(s, 0.7, 0.95)) * gain
    a = TAU * 2.6 * t
    carry(p, t, standing, shift=offset(0.0, -0.03 * on, 0.0), turns=[("z", 0.10 * on * np.sin(a - 1.6))])
    p.turn("spine", ("z", 0.14 * on * np.sin(a - 1.0)))
    p.turn("chest", ("z", 0.16 * on * np.sin(a - 0.5)))
    p.turn("neck", ("x", 0.3 * on), ("z", 0.2 * on * np.sin(a)))
    p.turn("head", ("x", 0.1 * on), ("z", 0.35 * on * np.sin(a + 0.3)))
    tail(p, 0.1 * on, 0.5 * on * np.sin(a - 2.4))
    stand_on(p, t)


def jump(p: Puppet, t: np.ndarray, span: float, gain: float) -> None:
    """Crouches, leaps forward and lands, fore paws first."""
    s = t / span
    far = 1.1 * gain
    go = far * ease((s - 0.27) / 0.46)
    high = 0.30 * gain * bump(s, 0.33, 0.52, 0.72)
    crouch, landing = bump(s, 0.05, 0.28, 0.42), bump(s, 0.60, 0.72, 0.93)
    nose = -0.42 * bump(s, 0.26, 0.42, 0.56) + 0.30 * bump(s, 0.48, 0.64, 0.82) + 0.06 * crouch
    shift = offset(0.0, high - 0.13 * crouch - 0.09 * landing, go - 0.05 * crouch)
    carry(p, t, standing, shift=shift, turns=[("x", nose)])
    p.turn("spine", ("x", 0.2 * crouch - 0.1 * bump(s, 0.36, 0.48, 0.6) + 0.22 * landing))
    p.turn("neck", ("x", 0.3 * crouch - 0.8 * np.minimum(nose, 0.0) - 0.5 * np.maximum(nose, 0.0)))
    p.turn("head", ("x", -0.2 * crouch))
    tail(p, 0.2 - 0.9 * bump(s, 0.34, 0.55, 0.8), 0.0 * t)
    for which, tip, off, on in (("fore", FORE_TIP, 0.31, 0.63), ("hind", HIND_TIP, 0.38, 0.72)):
        fly = np.clip((s - off) / (on - off), 0.0, 1.0)
        arc = np.sin(np.pi * fly) ** 2
        move = offset(0.0, (0.34 if which == "fore" else 0.36) * gain * arc, far * ease(fly))
        pitch = 0.9 * arc * (1 - fly) + (0.3 * crouch if which == "hind" else -0.1 * crouch)
        for side in "lr":
            leg(p, which, side, np.array(mirrored(tip, side)) + move, 0.0 * t, pitch)


# clip -> (length as a factor on frames_per_clip, the function that poses it)
CLIPS = {
    "walk": (1.1, walk),
    "trot": (0.9, trot),
    "gallop": (0.9, gallop),
    "turn": (1.2, turn),
    "look": (1.3, look),
    "wag": (1.1, wag),
    "sit": (1.4, sit),
    "shake": (0.9, shake),
    "jump": (1.0, jump),
}
