"""From artefacts to a report: rows, tables, figures and provenance of the finished cases."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from omegaconf import OmegaConf

from flows.config import CONF, NO_ABLATION
from flows.graph import Graph, Node
from flows.pipeline import Output, Planned
from flows.provenance import provenance
from flows.store import Ref, Store

UNSEEN = ("rmse_pct", "rmse", "rmse_coordinate")
MOTION = ("velocity_rmse", "speed_ratio", "max_error")
LEFT_OUT = ("rmse_spread", "rmse_left_out", "rmse_left_out_spread")
VIEWS = ("psnr", "ssim", "flip", "lpips", "ssim_down")
PATHS = ("path_pct", "path_start_pct")
RIG = ("bones_rmse_pct", "bones_count", "skeleton_rmse_pct", "joints_count")
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
CLOTH = ("deep_pct", "depth_995", "strain_p99_pct", "speed_max", "frames_count")
TRUTH = ("joint_f1", "joint_f1_fine", "link_f1", "j2j_pct", "j2b_pct", "b2b_pct")


@dataclass(frozen=True)
class Report:
    """A written report. tables: Markdown; shown: the same for the terminal."""

    folder: Path
    tables: str
    shown: list


def write(
    planned: list[Planned],
    pictures: list[Node],
    files: list[Output],
    graph: Graph,
    refs: dict[str, Ref],
    computed: set[str],
    store: Store,
    notes: list[str],
) -> Report:
    """Writes a report's folder and returns what to show of it. notes: remarks on the run, for the first table."""
    from tasks.evaluation import report, typeset
    from tasks.evaluation.rows import join

    settings = planned[0].case.config["report"]
    rows = join([_rows(p, refs, store) for p in planned])
    remarks = dict.fromkeys(f"{a.name}: {note}." for a in (_about(p, refs, store) for p in planned) for note in a.notes)
    tables = _tables(planned, rows, refs, settings, list(remarks), notes)
    figures = [(node.cases[0], store.load(refs[node.id], "picture")) for node in pictures]
    figures += _curve(planned, rows, settings["curve"])
    figures += _charts(rows, {p.case.method: p.case.config["animate"]["label"] for p in planned})
    folder = Path(settings["path"]).expanduser() / settings["name"]
    origin = provenance([p.case for p in planned], graph, refs, computed)
    brought = [store.load(refs[node.id], output) for node, output in files]
    report.write_report(folder, rows, tables, figures, origin, brought)
    markdown = "\n".join(typeset.markdown(t) for t in tables)
    return Report(folder, markdown, [typeset.terminal(t) for t in tables])


def _rows(case: Planned, refs: dict[str, Ref], store: Store):
    from tasks.evaluation.rows import join, rows_of

    config = case.case.config
    labels = {
        "experiment": config["report"]["name"],
        "dataset": case.case.dataset,
        "subject": _subject(case, refs, store),
        "method": case.case.method,
        "variant": _variant(case),
        "seed": case.case.seed,
    }
    found = [refs[node.id] for node in case.metrics]
    return join([rows_of(store.load(ref, "metrics"), key=ref.key, **labels) for ref in found])


def _tables(
    planned: list[Planned], rows, refs: dict[str, Ref], settings: dict, remarks: list[str], run_notes: list[str]
) -> list:
    from tasks.evaluation.paper import paper_of
    from tasks.evaluation.rows import with_means
    from tasks.evaluation.tables import build

    paper = paper_of(OmegaConf.to_container(OmegaConf.load(CONF / "paper" / "gaussianimate.yaml")))
    datasets = {p.case.dataset: p.case.config["dataset"] for p in planned}
    # bones and skeleton do not depend on the method, and seldom on the variant: one row for each that differs
    lead = rows[rows["method"] == planned[-1].case.method].drop_duplicates(
        ["dataset", "subject", "metric", "key", "seed"]
    )
    common = {
        "labels": {p.case.method: p.case.config["animate"]["label"] for p in planned},
        "data_status": {name: node["status"] for name, node in datasets.items()},
        "stands_for": {
            f"{dataset}/{subject}": datasets[dataset]["stands_for"]
            for dataset, subject in rows[["dataset", "subject"]].drop_duplicates().itertuples(index=False)
            if datasets[dataset]["stands_for"]
        },
        "baselines": settings["baselines"],
        "bounds": settings["bounds"],
    }
    if planned[0].case.config["pipeline"] == "make_garments":
        return _garment_tables(rows, settings, remarks, common)
    if planned[0].case.config["pipeline"] in BENCHMARKS:
        return _benchmark_tables(planned, rows, settings, common)
    notes = [*_notes(planned, settings), *run_notes]
    printed = {"paper": paper, "paper_table": settings["paper_table"]} if settings["paper_table"] else {}
    tables = []
    if rows["metric"].isin(VIEWS).any():
        seen = [m for m in VIEWS if rows["metric"].eq(m).any()]
        fits = _fit_notes(planned, refs)
        tables.append(
            build(with_means(rows), title=settings["title"], metrics=seen, notes=[*notes, *fits], **printed, **common)
        )
        notes, printed = [], {}
    if rows["metric"].isin(UNSEEN).any():
        title = "Vertex errors of the same results" if tables else settings["title"]
        tables.append(build(rows, title=title, metrics=UNSEEN, notes=notes, **printed, **common))
        tables += _gain_tables(rows, settings, paper, common)
        tables.append(build(rows, title="Motion of the same results", metrics=MOTION, notes=[], **common))
    if rows["metric"].isin(LEFT_OUT).any():
        runs = planned[0].case.config["evaluate"]["left_out"]
        note = f"Trained {runs} times, each time without one training clip: how far that moves the error on the unseen "
        note += "clips, and the error on the clips that were left out, bones kept. Settings are chosen by the latter."
        plain = common | {"baselines": []}
        tables.append(build(rows, title="One training clip left out", metrics=LEFT_OUT, notes=[note], **plain))
    if rows["metric"].isin(PATHS).any():
        tables.append(build(with_means(rows), title="Paths of the Gaussians", metrics=PATHS, notes=[], **common))
    shared = common | {"labels": common["labels"] | {planned[-1].case.method: "all methods"}, "baselines": []}
    rig_notes = ["Errors on the training frames that bones and skeleton were fitted to.", *remarks]
    if rows["metric"].isin(RIG).any():
        tables.append(build(lead, title="Bones and skeleton", metrics=RIG, notes=rig_notes, **shared))
    if rows["metric"].isin(TRUTH).any():
        tables.append(build(with_means(lead), title="Joints against the true rig", metrics=TRUTH, notes=[], **shared))
    return tables


def _fit_notes(planned: list[Planned], refs: dict[str, Ref]) -> list[str]:
    """How long the Gaussians took, which is no metric: it would differ from run to run."""
    took = {}
    for case in planned:
        if "reconstruction" in case.nodes:
            ref = refs[case.nodes["reconstruction"][0].id]
            took[f"{case.case.data} {_variant(case)}".strip(), ref.key] = ref.seconds / 60
    each = ", ".join(f"{name} {minutes:.1f}" for (name, _), minutes in took.items())
    return [f"Minutes to fit the Gaussians, timed when they were computed: {each}."] if took else []


def _garment_tables(rows, settings: dict, remarks: list[str], common: dict) -> list:
    """The cloth's quality as a whole, then clip by clip."""
    from tasks.evaluation.tables import build, unranked

    common |= {"data_status": {}, "stands_for": {}, "baselines": []}
    notes = [*remarks, *([settings["note"]] if settings["note"] else [])]
    clips = rows[rows["metric"].str.contains("@")]
    split = clips["metric"].str.split("@", n=1)
    clips = clips.assign(method=split.str[1], metric=split.str[0])
    shown = [(settings["title"], rows, (*CLOTH, "points_count"), notes), ("Clip by clip", clips, CLOTH, [])]
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


def _benchmark_tables(planned: list[Planned], rows, settings: dict, common: dict) -> list:
    """What decides first, then the numbers behind it; rows are subjects and columns peers, for few are compared."""
    from tasks.evaluation.tables import build, unranked

    config = planned[0].case.config
    first, others = BENCHMARKS[config["pipeline"]]
    repeats = config["benchmark"]["repeats"]
    runs = f"{repeats} runs of ours and {config['benchmark'].get('peer_repeats', repeats)} of the peer"
    notes = [
        f"Medians of {runs if others else f'{repeats} runs'}, timed when the stage was computed: a run that takes it "
        "from the store shows the same times.",
        *([settings["note"]] if settings["note"] else []),
    ]
    if others:
        notes.insert(0, "Ratios are ours / the peer's, timed in turn in one process; below 1 is better.")
    several = rows["dataset"].nunique() > 1
    subject = rows["dataset"] + " " + rows["subject"] if several else rows["subject"]
    turned = rows.assign(dataset=rows["method"], subject="", method=subject)
    common |= {"data_status": {}, "stands_for": {}, "baselines": []}

    def table(title: str, metrics: tuple[str, ...], notes: list[str]):
        return unranked(build(turned, title=title, metrics=metrics, notes=notes, **common))

    return [table(settings["title"], first, notes), *(table(t, metrics, []) for t, metrics in others.items())]


def _curve(planned: list[Planned], rows, curve: list[str] | None) -> list:
    """A metric against a key of the config, a line for every dataset."""
    from tasks.evaluation.charts import curve_chart
    from tasks.values import Picture

    if not curve:
        return []
    key, metric = curve
    where = {_variant(p): _at(p.case.config, key) for p in planned}
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
        variants = rows.loc[rows["method"] == method, "variant"]
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


def _notes(planned: list[Planned], settings: dict) -> list[str]:
    notes = []
    if any(p.case.config["skeleton"]["kind"] == "curve" for p in planned):
        notes.append(
            "Query poses of unseen clips come from inverse kinematics on the unseen geometry, "
            "as the paper does where the data brings no skeleton."
        )
    if all(p.case.config["dataset"]["status"] == "substitute" for p in planned):
        notes.append("No column is the paper's data: every one is a substitute, its numbers are not the paper's task.")
    return [*notes, settings["note"]] if settings["note"] else notes


def _variant(case: Planned) -> str:
    return "" if case.case.variant == NO_ABLATION else case.case.variant


def _about(case: Planned, refs: dict[str, Ref], store: Store):
    node, output = case.nodes["about"]
    return store.load(refs[node.id], output)


def _subject(case: Planned, refs: dict[str, Ref], store: Store) -> str:
    return re.sub(r"\s+", "_", _about(case, refs, store).name)
