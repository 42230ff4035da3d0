"""By how much one method beats every other, measured and printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from tasks.reporting.paper import Paper

GAIN = "gain_pct"


def gains(rows: pd.DataFrame, of: str, *, without: Sequence[str]) -> pd.DataFrame:
    """A row for every other method: how far the mean RMSE of ``of`` over seeds lies below its, in % of its.

    rows: as in metrics.csv, of which those without a variant count; without: methods that are left out.
    """
    chosen = rows[(rows["metric"] == "rmse") & (rows["variant"] == "") & ~rows["method"].isin(list(without))]
    mean = chosen.groupby(["dataset", "subject", "method"], sort=False)["value"].mean()
    one = chosen.drop_duplicates(["dataset", "subject", "method"])
    keys = list(one[["dataset", "subject", "method"]].itertuples(index=False, name=None))
    found = []
    for (_, row), (dataset, subject, method) in zip(one.iterrows(), keys, strict=True):
        if method != of and (dataset, subject, of) in mean.index and mean[dataset, subject, method] > 0:
            gain = _gain(mean[dataset, subject, of], mean[dataset, subject, method])
            found.append({**row, "metric": GAIN, "value": gain, "unit": "%"})
    return pd.DataFrame(found, columns=rows.columns)


def printed_gains(paper: Paper, number: int, of: str) -> Paper:
    """The same from the cells of one of the paper's tables; lost where one of the two numbers is."""
    cells = [c for c in paper.table(number) if c.metric == "rmse"]
    own = {(c.dataset, c.subject): c.value for c in cells if c.method == of}
    made = []
    for cell in cells:
        value = own.get((cell.dataset, cell.subject))
        if cell.method == of or value is None:
            continue
        gain = None if cell.value is None else _gain(value, cell.value)
        made.append(replace(cell, metric=GAIN, value=None if gain is None else round(gain, 1), unit="%"))
    return replace(paper, cells=tuple(made))


def _gain(value: float, other: float) -> float:
    return 100.0 * (1.0 - value / other)
