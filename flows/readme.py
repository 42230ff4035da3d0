"""``python -m flows.readme``: writes the tables of README.md anew from the numbers of reports/; its prose stays.

A table is known by the first cell of its head. Exit status: 0 done, 2 a report or a table that is not there.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from flows.contents import paper_numbers
from flows.source import ROOT
from tasks.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

GARMENTS = {
    "Compression floor (bones fitted to the unseen frames)": "compression_floor",
    "Robust LBS": "robust_lbs",
    "LBS, weights fitted to training": "lbs_fitted",
    "Nearest training frame": "nearest",
    "MLP": "mlp",
    "GRU": "gru",
    "FullMM": "fullmm",
    "PartMM, as the paper has it": "partmm",
    "PartMM+ (residual over LBS, past poses, mirrored clips, kriging)": "partmm_plus",
    "MLP+ (residual, dynamics, mirrored clips)": "mlp_plus",
    "GRU+": "gru_plus",
    "Part kernel (kernel regression by part, as PartMM+)": "part_kernel",
    "Bone kernel (kernel regression by bone, settings by left-out clips)": "bone_kernel",
    "Bone response (linear filter by bone)": "bone_response",
    "Part kernel + cloth (simulated where the kernel does not know)": "part_cloth",
    "PartMM+ + cloth (the same about what is matched)": "partmm_cloth",
}
MATCHED = {"FullMM": "fullmm", "PartMM": "partmm", "PartMM+": "partmm_plus", "Part kernel": "part_kernel"}
ANIMALS = {"LBS": "robust_lbs", "BBW": "bbw", "MLP": "mlp", "GRU": "gru", **MATCHED}
POSED = {"Ground-truth Gaussians": "ground_truth", "LBS": "lbs", "BoB": "bob", **MATCHED}
VIEWS = {
    "PSNR [dB]": ("psnr", 2),
    "SSIM": ("ssim", 3),
    "FLIP": ("flip", 3),
    "path error [%]": ("path_pct", 2),
}
Grid = list[list[str]]  # the head and the rows of a table


def main(arguments: list[str] | None = None) -> int:
    """The command line. Returns the exit status."""
    (file,) = map(Path, arguments if arguments is not None else sys.argv[1:] or [ROOT / "README.md"])
    try:
        file.write_text(filled(file.read_text("utf-8"), file.parent / "reports"), "utf-8")
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def filled(text: str, reports: Path) -> str:
    """README's text with its tables made from the reports. Raises InputError where a report or a table is absent."""
    for name, make in TABLES.items():
        head, *rows = make(_numbers(reports / name.split("/")[0]))
        start = text.find(f"\n| {head[0]} |")
        if start < 0:
            raise InputError("README", expected=f"a table with the head {head[0]!r}", found="none")
        end = text.find("\n\n", start)
        first, *others = (f"\n| {' | '.join(line)} |" for line in [head, *rows])
        text = text[:start] + "".join([first, "\n|" + "---|" * len(head), *others]) + text[end:]
    return text


def _numbers(folder: Path) -> pd.DataFrame:
    from tasks.reporting.rows import from_csv

    try:
        rows = from_csv((folder / "metrics.csv").read_text("utf-8"), str(folder / "metrics.csv"))
    except OSError as error:
        raise InputError(str(folder), expected="a report", found=error.strerror or str(error)) from None
    return rows[rows["variant"] == ""]


def _of(rows: pd.DataFrame, **where: str) -> pd.Series:
    for name, value in where.items():
        rows = rows[rows[name] == value]
    return rows["value"]


def _text(values: pd.Series, digits: int) -> str:
    return f"{values.mean():.{digits}f}" if len(values) else ""


def _garments(rows: pd.DataFrame) -> Grid:
    """Errors with their spread over seeds and their change against robust LBS, beside what the paper prints."""
    printed = {(c.method, c.subject): c.value for c in paper_numbers().table(3) if c.dataset == "vto"}

    def ours(method: str, dataset: str) -> str:
        values = _of(rows, metric="rmse", method=method, dataset=dataset)
        text = _text(values, 1) + (f" ± {values.std():.1f}" if len(values) > 1 else "")
        if method == "robust_lbs":
            return text
        change = 100 * (values.mean() / _of(rows, metric="rmse", method="robust_lbs", dataset=dataset).mean() - 1)
        return f"{text} ({'+' if change > 0 else '−'}{abs(change):.1f} %)"

    def theirs(method: str, subject: str) -> str:
        value = printed.get((method, subject), "")
        return "?" if value is None else str(value)

    head = ["RMSE [mm]", "T-shirt, ours", "VTO, paper", "dress, ours", "VTO, paper"]
    found = [head]
    for label, m in GARMENTS.items():
        if not (rows["method"] == m).any():
            continue
        shirt, dress = ((ours(m, f"garments_{subject}"), theirs(m, subject)) for subject in ("tshirt", "dress"))
        found.append([label, *shirt, *dress])
    return found


def _animals(rows: pd.DataFrame) -> Grid:
    rows = rows[~rows["dataset"].str.startswith("garments") & (rows["metric"] == "rmse_pct")]
    subjects = list(dict.fromkeys(rows["subject"]))
    body = [[label, *(_text(_of(rows, method=m, subject=s), 2) for s in subjects)] for label, m in ANIMALS.items()]
    return [["RMSE, % of the diagonal", *subjects], *body]


def _views(rows: pd.DataFrame) -> Grid:
    subjects = list(dict.fromkeys(rows["subject"]))
    rows = rows[rows["method"] == "gaussians"]
    body = []
    for label, (metric, digits) in VIEWS.items():
        means = [_of(rows, metric=metric, subject=s).mean() for s in subjects]
        body.append([label, *(f"{v:.{digits}f}" for v in [*means, sum(means) / len(means)])])
    return [["held-out views", *subjects, "mean"], *body]


def _posed(rows: pd.DataFrame) -> Grid:
    shown = [(s, *m) for s in dict.fromkeys(rows["subject"]) for m in (("psnr", 2, "PSNR [dB]"), ("ssim", 3, "SSIM"))]
    body = [
        [label, *(_text(_of(rows, metric=name, method=method, subject=s), digits) for s, name, digits, _ in shown)]
        for label, method in POSED.items()
    ]
    return [["unseen poses", *(f"{s}, {called}" for s, _, _, called in shown)], *body]


TABLES: dict[str, Callable[[pd.DataFrame], Grid]] = {  # by the report, and which of its tables
    "table3_full/garments": _garments,
    "table3_full/others": _animals,
    "table2": _views,
    "table4": _posed,
}

if __name__ == "__main__":
    sys.exit(main())
