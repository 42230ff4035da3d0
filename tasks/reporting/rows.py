"""metrics.csv: one row a number."""

from __future__ import annotations

import io
import math

import pandas as pd

from tasks.errors import InputError
from tasks.values import Metrics

COLUMNS = ("experiment", "dataset", "subject", "method", "variant", "metric", "value", "unit", "seed", "key")


def rows_of(
    metrics: Metrics,
    *,
    experiment: str,
    dataset: str,
    subject: str,
    method: str,
    variant: str,
    seed: int,
    key: str,
) -> pd.DataFrame:
    """One case's numbers as rows with the columns ``COLUMNS``. key: the case's content digest."""
    count = len(metrics.names)
    shared = {"experiment": experiment, "dataset": dataset, "subject": subject, "method": method, "variant": variant}
    table = {name: [value] * count for name, value in shared.items()}
    table["metric"] = list(metrics.names)
    table["value"] = [float(v) for v in metrics.values]
    table["unit"] = list(metrics.units)
    table["seed"] = [int(seed)] * count
    table["key"] = [key] * count
    return pd.DataFrame(table, columns=list(COLUMNS))


def join(pieces: list[pd.DataFrame]) -> pd.DataFrame:
    """The rows of several cases in the order given; an empty frame of the right columns for none."""
    some = [piece for piece in pieces if len(piece)]  # an empty one would turn the seeds into floats
    return pd.concat(some, ignore_index=True) if some else pd.DataFrame(columns=list(COLUMNS))


def with_means(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows, and as a column of its own the mean over the subjects where every one has the metric.

    For numbers that mean the same on every subject (percent, ratio, decibel); nothing is added for a single subject.
    """
    everyone = rows.groupby(["dataset", "subject"]).ngroups
    keys = ["method", "variant", "metric", "unit", "seed"]
    groups = rows.groupby(keys, sort=False)
    means = groups["value"].mean()[groups.size() == everyone].reset_index()
    if everyone < 2 or means.empty:
        return rows
    means = means.assign(experiment=rows["experiment"].iloc[0], dataset="mean", subject="", key="")
    return join([rows, means[list(COLUMNS)]])


def to_csv(rows: pd.DataFrame) -> str:
    """The text of metrics.csv. Floats are written with as few digits as give back the same bits, so equal rows give
    equal bytes. Raises ValueError on a value that is not finite."""
    bad = [v for v in rows["value"] if not math.isfinite(v)]
    if bad:
        raise ValueError(f"metrics.csv holds finite numbers only, got {bad[0]}")
    return rows[list(COLUMNS)].to_csv(index=False, lineterminator="\n", float_format=lambda v: repr(float(v)))


def from_csv(text: str, where: str) -> pd.DataFrame:
    """Reads what :func:`to_csv` wrote, to the last bit. where: the file's name, for the error.

    Raises InputError where a column is missing or a value is not a number.
    """
    header = text.split("\n", 1)[0].split(",")
    if header != list(COLUMNS):
        raise InputError(where, expected=f"the columns {','.join(COLUMNS)}", found=",".join(header))
    rows = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    try:  # Python's own float() gives back the bits on every version of pandas
        rows["value"] = [float(v) for v in rows["value"]]
        rows["seed"] = [int(v) for v in rows["seed"]]
    except ValueError as error:
        raise InputError(where, expected="numbers in the columns value and seed", found=str(error)) from error
    return rows
