"""From artefacts to a report: rows, tables, figures and provenance of the finished cases."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from flows.config import CONF, NO_ABLATION, Case
from flows.pipeline import Planned
from flows.provenance import provenance
from flows.schema import JOINTS
from flows.store import Ref, Store

if TYPE_CHECKING:
    import pandas as pd

    from flows.batch import Experiment, Work
    from tasks.evaluation.paper import Paper
    from tasks.evaluation.tables import Table
    from tasks.values import Picture

UNSEEN = ("rmse_pct", "rmse", "rmse_coordinate")
MOTION = ("velocity_rmse", "speed_ratio", "max_error")
CONFIDENCE = ("confidence_spearman", "outside_pct")
LEFT_OUT = ("rmse_spread", "rmse_left_out", "rmse_left_out_spread")
VIEWS = ("psnr", "ssim", "flip", "lpips", "ssim_down")
PATHS = ("path_pct", "path_start_pct")
RIG = ("bones_rmse_pct", "bones_count", "bone_fragments", "skeleton_rmse_pct", "joints_count")
# of each benchmark: what decides, then the numbers behind it by the titles of their tables
BENCHMARKS = {
    "benchmark_bones": (
        ("time_ratio", "rmse_ratio", "time_to_peer_rmse_ratio", "held_out_rmse_ratio"),
        {
            "Time and error of both": ("seconds", "peer_seconds", "bones_rmse_pct", "peer_rmse_pct"),
            "Processor time, memory, bones": ("cpu_ratio", "memory", "peer_memory", "bones_count", "peer_bones_count"),
        },
    ),
    "scale_bones": (
        ("points_exponent", "frames_exponent", "points_count", "frames_count", "seconds", "memory"),
        {},
    ),
    "benchmark_matching": (
        ("fps", "p99_ms", "clip_fps", "query_ms", "recall_at_7", "build_seconds", "memory"),
        {},
    ),
    "benchmark_stages": (
        ("points_count", "frames_count", "bones_count", "seconds", "cpu_seconds", "memory"),
        {"Stage by stage": ("seconds", "cpu_seconds", "memory")},
    ),
    "benchmark_rasterizer": (
        ("time_ratio", "forward_ratio"),
        {
            "Drawing with gradients, case by case": ("step_ms", "peer_step_ms", "time_ratio"),
            "Drawing alone, case by case": ("forward_ms", "peer_forward_ms", "forward_ratio"),
        },
    ),
    "benchmark_skeleton": (
        ("time_ratio", "cpu_ratio", "seconds", "peer_seconds", "memory", "peer_memory"),
        {
            "Ends": ("curve_leaves", "peer_curve_leaves", "peer_curve_limbs"),
            "Forks and loops": ("curve_junctions", "peer_curve_junctions", "curve_cycles", "peer_curve_cycles"),
            "Nodes inside, vertices mapped": (
                *("curve_inside_pct", "peer_curve_inside_pct"),
                *("curve_mapped_pct", "peer_curve_mapped_pct"),
            ),
        },
    ),
}
BY_CASE = ("benchmark_rasterizer", "benchmark_stages")  # their rows are cases; the first table is about all of them
SCENES = ("images_count", "views_count", "frames_count", "fill_pct", "on_subject_pct")
CLOTH = ("deep_pct", "depth_995", "strain_p99_pct", "speed_max", "frames_count")
OTHER_WAYS = tuple(f"by {way}" for way in JOINTS)  # ends of the rows' names that show the other way to joints
TRUTH = ("joint_f1", "joint_f1_fine", "link_f1", "j2j_pct", "j2b_pct", "b2b_pct")


@dataclass(frozen=True)
class Report:
    """A written report; without a folder, of an experiment that had nothing to write. figures: (subject, picture)."""

    experiment: Experiment
    folder: Path | None = None
    rows: pd.DataFrame | None = None
    tables: list[Table] = field(default_factory=list)
    figures: list[tuple[str, Picture]] = field(default_factory=list)
    cases: list[Case] = field(default_factory=list)
    provenance: dict = field(default_factory=dict)

    @property
    def markdown(self) -> str:
        """The tables for Prefect's page."""
        from tasks.evaluation import typeset

        return "\n".join(typeset.markdown(t) for t in self.tables)

    @property
    def shown(self) -> list:
        """The tables for the terminal."""
        from tasks.evaluation import typeset

        return [typeset.terminal(t) for t in self.tables]

    @property
    def line(self) -> str:
        """The report in a line, for the terminal."""
        said = [f"report in {self.folder}"] if self.folder else []
        said += [f"not run: {what}: {why}" for what, why in self.experiment.not_run]
        return f"{self.experiment.name}: {'; '.join(said)}"


def write(work: Work, refs: dict[str, Ref], computed: set[str], store: Store) -> Report:
    """Writes a report's folder."""
    from tasks.evaluation import report
    from tasks.evaluation.rows import join

    planned, cases = work.planned, [p.case for p in work.planned]
    settings = cases[0].config["report"]
    rows = join([_rows(p, refs, store) for p in planned])
    about = [_about(p, refs, store) for p in planned]
    about += [
        store.load(refs[n.id], o) for n, o in (p.nodes["driven_about"] for p in planned if "driven_about" in p.nodes)
    ]
    remarks = list(dict.fromkeys(f"{a.name}: {note}." for a in about for note in a.notes))
    said = [f"Not run: {what}, {why}." for what, why in work.experiment.not_run] + _fit_notes(planned, refs)
    tables = tables_of(cases, rows, remarks, said)
    figures = [(node.cases[0], store.load(refs[node.id], "picture")) for node in work.pictures]
    figures += _curve(cases, rows, settings["curve"])
    figures += _charts(rows, labels_of(cases))
    folder = Path(settings["path"]).expanduser() / settings["name"]
    origin = provenance(work.experiment.arguments, cases, work.graph, refs, computed)
    origin |= {"remarks": remarks, "said": said, "missing": [asdict(one) for one in work.experiment.missing]}
    brought = [store.load(refs[node.id], output) for node, output in work.files]
    report.write_report(folder, rows, tables, figures, origin, brought)
    return Report(work.experiment, folder, rows, tables, figures, cases, origin)


def _rows(case: Planned, refs: dict[str, Ref], store: Store):
    from tasks.evaluation.rows import join, rows_of

    config = case.case.config
    labels = {
        "experiment": config["report"]["name"],
        "dataset": case.case.dataset,
        "subject": _subject(case, refs, store),
        "method": case.case.method,
        "variant": _variant(case.case),
        "seed": case.case.seed,
    }

    def rows(node, **other) -> pd.DataFrame:
        ref = refs[node.id]
        return rows_of(store.load(ref, "metrics"), key=ref.key, **(labels | other))

    beside = [
        rows(node, variant=", ".join(filter(None, [labels["variant"], name]))) for name, node in case.beside.items()
    ]
    return join([*(rows(node) for node in case.metrics), *(found for found in beside if len(found))])


def tables_of(cases: list[Case], rows, remarks: list[str], said: list[str]) -> list:
    """The tables of an experiment, from its cases' configs and the rows of its metrics.csv. remarks: on the data; said:
    of the run."""
    from tasks.evaluation.rows import with_means
    from tasks.evaluation.tables import build, unranked

    paper, settings = paper_numbers(), cases[0].config["report"]
    data_status, stands_for = places(cases, rows)
    # bones and skeleton do not depend on the method, and seldom on the variant: one row for each that differs
    lead = rows[rows["method"] == cases[-1].method].drop_duplicates(["dataset", "subject", "metric", "key", "seed"])
    common = {
        "labels": labels_of(cases),
        "data_status": data_status,
        "stands_for": stands_for,
        "baselines": settings["baselines"],
        "bounds": settings["bounds"],
    }
    if cases[0].config["pipeline"] == "make_garments":
        return _garment_tables(rows, settings, remarks, common)
    if cases[0].config["pipeline"] == "make_scenes":
        notes = [*([settings["note"]] if settings["note"] else []), *remarks, *said]
        common |= {"data_status": {}, "stands_for": {}, "baselines": []}
        return [unranked(build(rows, title=settings["title"], metrics=SCENES, notes=notes, **common))]
    if cases[0].config["pipeline"] in BENCHMARKS:
        return _benchmark_tables(cases, rows, settings, common)
    notes = [*_notes(cases, settings), *said]
    printed = {"paper": paper, "paper_table": settings["paper_table"]} if settings["paper_table"] else {}
    tables = []
    if rows["metric"].isin(VIEWS).any():
        seen = [m for m in VIEWS if rows["metric"].eq(m).any()]
        tables.append(build(with_means(rows), title=settings["title"], metrics=seen, notes=notes, **printed, **common))
        notes, printed = [], {}
    if rows["metric"].isin(UNSEEN).any():
        title = "Vertex errors of the same results" if tables else settings["title"]
        tables.append(build(rows, title=title, metrics=UNSEEN, notes=notes, **printed, **common))
        tables += _gain_tables(rows, settings, paper, common)
        tables.append(build(rows, title="Motion of the same results", metrics=MOTION, notes=[], **common))
    if rows["metric"].isin(CONFIDENCE).any():
        note = (
            "Expected from a pose's distance to the database alone, calibrated by leaving training clips out: how well "
        )
        note += "it ranks the frames by the error that each row makes there. Outside: farther off than 95 % of those."
        plain = common | {"baselines": []}
        tables.append(build(rows, title="Confidence", metrics=CONFIDENCE, notes=[note], **plain))
    if rows["metric"].isin(LEFT_OUT).any():
        runs = cases[0].config["evaluate"]["left_out"]
        note = f"Trained {runs} times, each time without one training clip: how far that moves the error on the unseen "
        note += "clips, and the error on the clips that were left out, bones kept. Settings are chosen by the latter."
        plain = common | {"baselines": []}
        tables.append(build(rows, title="One training clip left out", metrics=LEFT_OUT, notes=[note], **plain))
    if rows["metric"].isin(PATHS).any():
        tables.append(build(with_means(rows), title="Paths of the Gaussians", metrics=PATHS, notes=[], **common))
    shared = common | {"labels": common["labels"] | {cases[-1].method: "all methods"}, "baselines": []}
    rig_notes = ["Errors on the training frames that bones and skeleton were fitted to.", *remarks]
    if rows["metric"].isin(RIG).any():
        main = lead[~lead["variant"].str.endswith(OTHER_WAYS)]
        tables.append(build(main, title="Bones and skeleton", metrics=RIG, notes=rig_notes, **shared))
    if rows["metric"].isin(TRUTH).any():
        note = "Rows 'by …' take the other way to joints on the same bones and curve: by motion, or by the "
        note += "gradient of the weights along the curve (the paper's eq. 5)."
        notes = [note] if lead["variant"].str.endswith(OTHER_WAYS).any() else []
        title = "Joints against the true rig"
        tables.append(build(with_means(lead), title=title, metrics=TRUTH, notes=notes, **shared))
    return tables


def _fit_notes(planned: list[Planned], refs: dict[str, Ref]) -> list[str]:
    """How long the Gaussians took, which is no metric: it would differ from run to run."""
    took = {}
    for case in planned:
        if "reconstruction" in case.nodes:
            ref = refs[case.nodes["reconstruction"][0].id]
            took[f"{case.case.data} {_variant(case.case)}".strip(), ref.key] = ref.seconds / 60
    each = ", ".join(f"{name} {minutes:.1f}" for (name, _), minutes in took.items())
    return [f"Minutes to fit the Gaussians, timed when they were computed: {each}."] if took else []


def _garment_tables(rows, settings: dict, remarks: list[str], common: dict) -> list:
    """The cloth's quality as a whole, then clip by clip."""
    from tasks.evaluation.tables import build, unranked

    common |= {"data_status": {}, "stands_for": {}, "baselines": []}
    notes = [*remarks, *([settings["note"]] if settings["note"] else [])]
    shown = [(settings["title"], rows, (*CLOTH, "points_count"), notes), ("Clip by clip", _by_case(rows), CLOTH, [])]
    return [unranked(build(r, title=title, metrics=m, notes=n, **common)) for title, r, m, n in shown]


def _gain_tables(rows, settings: dict, paper, common: dict) -> list:
    """How far each of the methods asked for lies below every other one, beside what the paper prints."""
    from tasks.evaluation.gains import GAIN, gains, printed_gains
    from tasks.evaluation.tables import build, unranked

    number, tables = settings["paper_table"], []
    for method in settings["gains_of"]:
        found = gains(rows, method, without=settings["bounds"])
        if found.empty:
            continue
        printed = {"paper": printed_gains(paper, number, method), "paper_table": number} if number else {}
        title = f"How far {common['labels'].get(method, method)} lies below every other row"
        notes = ["The paper's are computed from the RMSE that it prints."] if number else []
        plain = common | {"baselines": []}
        tables.append(unranked(build(found, title=title, metrics=[GAIN], notes=notes, **printed, **plain)))
    return tables


def paper_numbers() -> Paper:
    """What the paper prints."""
    from tasks.evaluation.paper import paper_of

    return paper_of(OmegaConf.to_container(OmegaConf.load(CONF / "paper" / "gaussianimate.yaml")))


def places(cases: list[Case], rows) -> tuple[dict[str, str], dict[str, str]]:
    """By dataset, whether it is the paper's; by dataset and subject, the paper's column that it stands for."""
    datasets = {c.dataset: c.config["dataset"] for c in cases}
    stands_for = {
        f"{dataset}/{subject}": datasets[dataset]["stands_for"]
        for dataset, subject in rows[["dataset", "subject"]].drop_duplicates().itertuples(index=False)
        if datasets[dataset]["stands_for"]
    }
    return {name: node["status"] for name, node in datasets.items()}, stands_for


def _benchmark_tables(cases: list[Case], rows, settings: dict, common: dict) -> list:
    """What decides first, then the numbers behind it; rows are subjects and columns peers, for few are compared."""
    from tasks.evaluation.tables import build, unranked

    config = cases[0].config
    first, others = BENCHMARKS[config["pipeline"]]
    repeats = config["benchmark"]["repeats"]
    runs = f"{repeats} runs of ours and {config['benchmark'].get('peer_repeats', repeats)} of the peer"
    peer = any(name.startswith("peer_") for metrics in others.values() for name in metrics)
    notes = [
        f"Medians of {runs if peer else f'{repeats} runs'}, timed when the stage was computed: a run that takes it "
        "from the store shows the same times.",
        *([settings["note"]] if settings["note"] else []),
    ]
    if peer:
        notes.insert(0, "Ratios are ours / the peer's, timed in turn in one process; below 1 is better.")
    several = rows["dataset"].nunique() > 1
    subject = rows["dataset"] + " " + rows["subject"] if several else rows["subject"]
    turned = rows.assign(dataset=rows["method"], subject="", method=subject)
    common |= {"data_status": {}, "stands_for": {}, "baselines": []}

    def table(title: str, metrics: tuple[str, ...], notes: list[str]):
        return unranked(build(turned, title=title, metrics=metrics, notes=notes, **common))

    tables = [table(settings["title"], first, notes)]
    if config["pipeline"] in BY_CASE:
        turned = _by_case(rows)
    return [*tables, *(table(t, metrics, []) for t, metrics in others.items())]


def _by_case(rows):
    """The rows "metric@case" with the case as the row's name."""
    named = rows[rows["metric"].str.contains("@")]
    split = named["metric"].str.split("@", n=1)
    return named.assign(method=split.str[1], metric=split.str[0])


def _curve(cases: list[Case], rows, curve: list[str] | None) -> list:
    """A metric against a key of the config: a line for every dataset, or of several methods one chart a dataset."""
    from tasks.evaluation.charts import curve_chart, methods_chart
    from tasks.values import Picture

    if not curve:
        return []
    key, metric = curve
    where = {_variant(c): _at(c.config, key) for c in cases}
    if rows["method"].nunique() > 1:
        labels = {c.method: c.config["animate"]["label"] for c in cases}
        drawn = []
        for dataset, subject in rows[["dataset", "subject"]].drop_duplicates().itertuples(index=False, name=None):
            of = {"dataset": dataset, "subject": subject, "where": where, "label": key, "labels": labels}
            picture = Picture(
                "curve", f"{subject}: {metric} against {key}", None, methods_chart(rows, metric=metric, **of)
            )
            drawn.append((f"{dataset}_{subject}", picture))
        return drawn
    chart = curve_chart(rows, metric=metric, where=where, label=key)
    return [("all", Picture("curve", f"{metric} against {key}", None, chart))]


def _at(config: dict, key: str) -> float:
    for part in key.split("."):
        config = config[part]
    return float(config)


def _charts(rows, labels: dict[str, str]) -> list:
    """Errors by clip where methods are compared, changes by variant where one method is varied."""
    from tasks.evaluation.charts import ablation_chart, clips_chart
    from tasks.values import Picture

    drawn = []
    for method in dict.fromkeys(rows["method"]):
        variants = rows.loc[(rows["method"] == method) & (rows["metric"] == "rmse"), "variant"]
        if variants.eq("").any() and variants.ne("").any():
            chart = ablation_chart(rows, metric="rmse", method=method, labels=labels)
            caption = f"{labels[method]}: change of the RMSE on unseen clips by each variant"
            drawn.append((method, Picture("ablation", caption, None, chart)))
    plain = rows[(rows["variant"] == "") & rows["metric"].str.startswith("rmse@")]
    for (dataset, subject), group in plain.groupby(["dataset", "subject"], sort=False):
        if group["method"].nunique() > 1:
            chart = clips_chart(rows, metric="rmse", dataset=dataset, subject=subject, labels=labels)
            drawn.append(
                (f"{dataset}_{subject}", Picture("clips", f"{subject}: RMSE on each unseen clip", None, chart))
            )
    return drawn


def labels_of(cases: list[Case]) -> dict[str, str]:
    """What to call the methods."""
    return {c.method: c.config["animate"]["label"] for c in cases}


def _notes(cases: list[Case], settings: dict) -> list[str]:
    notes = []
    if any(c.config["pipeline"] == "animate" and c.config["skeleton"]["kind"] == "curve" for c in cases):
        notes.append(
            "Query poses of unseen clips come from inverse kinematics on the unseen geometry, "
            "as the paper does where the data brings no skeleton."
        )
    if all(c.config["dataset"]["status"] == "substitute" for c in cases):
        notes.append("No column is the paper's data: every one is a substitute, its numbers are not the paper's task.")
    return [*notes, settings["note"]] if settings["note"] else notes


def _variant(case: Case) -> str:
    return "" if case.variant == NO_ABLATION else case.variant


def _about(case: Planned, refs: dict[str, Ref], store: Store):
    node, output = case.nodes["about"]
    return store.load(refs[node.id], output)


def _subject(case: Planned, refs: dict[str, Ref], store: Store) -> str:
    return re.sub(r"\s+", "_", _about(case, refs, store).name)
