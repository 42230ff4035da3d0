"""Whether what is said about a pose beforehand comes true, and who wants to read it frame by frame."""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

from tasks.evaluation.metrics import clip_keys, declared, frame_rmse
from tasks.values import Animation, Confidence, Files, Metrics, Motion

FAR = 0.95  # share of training frames beyond which a pose counts as outside


def evaluate_confidence(confidence: Confidence, animation: Animation, test: Motion) -> Metrics:
    """Rank correlation (Spearman) of the expected error with the result's own, frame by frame, and how much of the test
    lies outside the database, as a whole and clip by clip; these are left out where one training clip left nothing to
    judge by. By clip and part, how far the poses lie from the database: "query_distance@clip, part" in degrees."""
    found: dict[str, float] = {}
    clips = list(zip(clip_keys(test.clip_names), test.clips(), strict=True))
    if confidence.expected.any():
        true = frame_rmse(animation.points, test.points)
        found["outside_pct"] = 100.0 * float(np.mean(confidence.outside > FAR))
        if np.ptp(true) > 0 and np.ptp(confidence.expected) > 0:
            found["confidence_spearman"] = float(np.corrcoef(rankdata(confidence.expected), rankdata(true))[0, 1])
        found |= {f"outside_pct@{key}": 100.0 * float(np.mean(confidence.outside[clip] > FAR)) for key, clip in clips}
    for key, clip in clips:
        angles = np.degrees(confidence.distance[clip].mean((0, 2), dtype=np.float64))
        found |= {f"query_distance@{key}, {part}": float(a) for part, a in zip(confidence.parts, angles, strict=True)}
    return declared(found, test.unit)


def confidence_file(confidence: Confidence, test: Motion, train: Motion, *, name: str) -> Files:
    """A table of text: for each unseen frame and part the matched training frames and their distances in radians."""
    count = confidence.windows.shape[2]
    head = ["clip", "frame", "expected_error", "outside", "part"]
    head += [f"{what}_{i + 1}" for i in range(count) for what in ("source", "radians")]
    lines = [",".join(head)]
    clip_of = np.searchsorted(train.clip_start, np.arange(train.frames), side="right") - 1
    place = [f"{train.clip_names[c]}:{f - train.clip_start[c]}" for f, c in enumerate(clip_of)]
    for clip_name, clip in zip(test.clip_names, test.clips(), strict=True):
        for f in range(clip.start, clip.stop):
            start = f"{clip_name},{f - clip.start},{confidence.expected[f]:.5g},{confidence.outside[f]:.3f}"
            for p, part in enumerate(confidence.parts):
                pairs = zip(confidence.windows[f, p], confidence.distance[f, p], strict=True)
                lines.append(",".join([start, part, *(f"{place[w]},{d:.4f}" for w, d in pairs)]))
    return Files.of({f"confidence/{name}.csv": ("\n".join(lines) + "\n").encode()})
