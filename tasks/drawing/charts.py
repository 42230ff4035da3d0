"""Charts of the rows of metrics.csv, as the text of an SVG."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from tasks.drawing import plot
from tasks.evaluation.metrics import METRICS


def ablation_chart(rows: pd.DataFrame, *, metric: str, method: str, labels: Mapping[str, str]) -> str:
    """What each variant of a method changes against the method as it is, in %, a colour for each subject.

    rows: as in metrics.csv; labels: by "method/variant", "dataset/subject" or either's last part. The change is taken
    seed by seed; whiskers are its standard deviation. Raises ValueError where the plain method is missing.
    """
    chosen = rows[(rows["metric"] == metric) & (rows["method"] == method)]
    variants = [v for v in dict.fromkeys(chosen["variant"]) if v]
    series = []
    for (dataset, subject), group in chosen.groupby(["dataset", "subject"], sort=False):
        values = group.pivot(index="seed", columns="variant", values="value")
        if "" not in values:
            raise ValueError(f"no {method} without a variant on {dataset}/{subject}")
        change = 100.0 * (values.div(values[""], axis=0) - 1.0).reindex(columns=variants)
        spread = change.std(ddof=1).fillna(0.0).to_numpy()
        name = _label(labels, f"{dataset}/{subject}")
        series.append(plot.Series(name, change.mean().to_numpy(), np.empty(0), spread))
    names = [_label(labels, f"{method}/{variant}") for variant in variants]
    text = f"change of {METRICS[metric].label} [%]" + (", left is better" if METRICS[metric].better == "lower" else "")
    return plot.dots(names, series, x=text, zero=labels.get(method, method))


def clips_chart(rows: pd.DataFrame, *, metric: str, dataset: str, subject: str, labels: Mapping[str, str]) -> str:
    """A metric on each unseen clip, a colour for each method; means over seeds, whiskers their standard deviation.

    Takes the rows named "metric@clip" of one subject. Raises ValueError where there are none.
    """
    of_subject = rows[(rows["dataset"] == dataset) & (rows["subject"] == subject) & (rows["variant"] == "")]
    chosen = of_subject[of_subject["metric"].str.startswith(f"{metric}@")]
    if chosen.empty:
        raise ValueError(f"no rows {metric}@clip of {dataset}/{subject}")
    clips = list(dict.fromkeys(chosen["metric"]))
    series = []
    for method, group in chosen.groupby("method", sort=False):
        by_clip = group.groupby("metric", sort=False)["value"]
        mean, spread = by_clip.mean().reindex(clips), by_clip.std(ddof=1).reindex(clips).fillna(0.0)
        series.append(plot.Series(_label(labels, str(method)), mean.to_numpy(), np.empty(0), spread.to_numpy()))
    names = [clip.partition("@")[2] for clip in clips]
    return plot.dots(names, series, x=f"{METRICS[metric].label} [{chosen['unit'].iloc[0]}]")


def curve_chart(rows: pd.DataFrame, *, metric: str, where: Mapping[str, float], label: str) -> str:
    """A metric against a setting that the variants differ in, a line for every subject, and their mean.

    where: variant -> value of the setting; label: the setting's name. Means over seeds and methods.
    """
    chosen = rows[rows["metric"] == metric].assign(x=rows["variant"].map(where))
    table = chosen.pivot_table(index="x", columns=["dataset", "subject"], values="value", aggfunc="mean", sort=True)
    x = table.index.to_numpy(float)
    series = [plot.Series(str(subject), x, table[dataset, subject].to_numpy()) for dataset, subject in table.columns]
    if len(series) > 1:
        mean = plot.Series("mean", x, table.mean(axis=1).to_numpy())
        series = [mean] if len(series) > len(plot.COLOURS) - 1 else [mean, *series]
    return plot.lines(series, x=label, y=METRICS[metric].label)


def methods_chart(
    rows: pd.DataFrame,
    *,
    metric: str,
    dataset: str,
    subject: str,
    where: Mapping[str, float],
    label: str,
    labels: Mapping[str, str],
) -> str:
    """A metric of one subject against a setting that the variants differ in, a line for every method; means over seeds.
    where, label: as for :func:`curve_chart`; labels: what to call methods."""
    chosen = rows[(rows["metric"] == metric) & (rows["dataset"] == dataset) & (rows["subject"] == subject)]
    series = []
    for method, group in chosen.assign(x=chosen["variant"].map(where)).groupby("method", sort=False):
        mean = group.groupby("x")["value"].mean()
        series.append(plot.Series(_label(labels, str(method)), mean.index.to_numpy(float), mean.to_numpy()))
    return plot.lines(series, x=label, y=f"{METRICS[metric].label} [{chosen['unit'].iloc[0]}]", log_x=True)


def _label(labels: Mapping[str, str], name: str) -> str:
    return labels.get(name, name.rpartition("/")[2])
