"""What a report holds: its tables and charts, chosen by the experiment's configs and the metrics that its rows have."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from flows.compose import CONF
from flows.config import NO_ABLATION, Case
from flows.schema import JOINTS

if TYPE_CHECKING:
    from tasks.reporting.paper import Paper

UNSEEN = ("rmse_pct", "rmse", "rmse_coordinate")
MOTION = ("velocity_rmse", "speed_ratio", "max_error")
CONFIDENCE = ("confidence_spearman", "outside_pct")
DISTANCE = "query_distance"
PART_ERROR = "part_rmse"
PART_ERROR_OF = (  # side by side, where they were run
    *("robust_lbs", "mlp", "gru", "fullmm", "partmm"),
    *("partmm_plus", "part_kernel", "part_cloth", "partmm_cloth"),
)
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
ON_CONFIDENCE = (
    "Expected from a pose's distance to the database alone, calibrated by leaving training clips out: how well it "
    "ranks the frames by the error that each row makes there. Outside: farther off than 95 % of those."
)
BY_PART = "Distance of the unseen poses from the database, by clip and part"
ON_DISTANCE = (
    "Mean over a part's joints of the angle to the nearest windows of the training clips; differences of the root's "
    "gravity and motion count as angles too, by the weight confidence.dynamics. It is the same for all methods."
)
ON_PART_ERROR = (
    "A vertex belongs to the part that holds most of its skin weight. How far each part's unseen poses lie from the "
    "database stands above."
)
ON_LEFT_OUT = (
    "Trained {runs} times, each time without one training clip: how far that moves the error on the unseen clips, and "
    "the error on the clips that were left out, bones kept. Settings are chosen by the latter."
)
ON_OTHER_WAYS = (
    "Rows 'by …' take the other way to joints on the same bones and curve: by motion, or by the gradient of the "
    "weights along the curve (the paper's eq. 5)."
)
TRUTH = ("joint_f1", "joint_f1_fine", "link_f1", "j2j_pct", "j2b_pct", "b2b_pct")


def tables_of(cases: list[Case], rows, remarks: list[str], said: list[str]) -> list:
    """The tables of an experiment, from its cases' configs and the rows of its metrics.csv. remarks: on the data; said:
    of the run."""
    from tasks.reporting.tables import build, unranked

    paper, settings = paper_numbers(), cases[0].config["report"]
    data_status, stands_for = places(cases, rows)
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
    tables = _result_tables(cases, rows, settings, [*_notes(cases, settings), *said], paper, common)
    return [*tables, *_rig_tables(cases, rows, remarks, common)]


def charts_of(cases: list[Case], rows) -> list:
    """Charts over all cases as (subject, picture)."""
    return [*_curve(cases, rows, cases[0].config["report"]["curve"]), *_charts(rows, labels_of(cases))]


def _result_tables(cases: list[Case], rows, settings: dict, notes: list[str], paper, common: dict) -> list:
    """What the methods made: images, vertices, motion, confidence, paths. The first table has notes and the paper."""
    from tasks.reporting.rows import with_means
    from tasks.reporting.tables import build

    has = {str(m) for m in rows["metric"].unique()}
    plain = common | {"baselines": []}
    first = {"notes": notes} | (
        {"paper": paper, "paper_table": settings["paper_table"]} if settings["paper_table"] else {}
    )
    tables = []
    if has & set(VIEWS):
        seen = [m for m in VIEWS if m in has]
        tables.append(build(with_means(rows), title=settings["title"], metrics=seen, **first, **common))
    if has & set(UNSEEN):
        title, first = ("Vertex errors of the same results", {"notes": []}) if tables else (settings["title"], first)
        tables.append(build(rows, title=title, metrics=UNSEEN, **first, **common))
        tables += _gain_tables(rows, settings, paper, common)
        tables.append(build(rows, title="Motion of the same results", metrics=MOTION, notes=[], **common))
    if has & set(CONFIDENCE):
        tables.append(build(rows, title="Confidence", metrics=CONFIDENCE, notes=[ON_CONFIDENCE], **plain))
    tables += [*_distance_tables(cases, rows, plain), *_part_error_tables(rows, common)]
    if has & set(LEFT_OUT):
        notes = [ON_LEFT_OUT.format(runs=cases[0].config["evaluate"]["left_out"])]
        tables.append(build(rows, title="One training clip left out", metrics=LEFT_OUT, notes=notes, **plain))
    if has & set(PATHS):
        tables.append(build(with_means(rows), title="Paths of the Gaussians", metrics=PATHS, notes=[], **common))
    return tables


def _distance_tables(cases: list[Case], rows, common: dict) -> list:
    """How far the unseen poses lie from the database, by clip and part; it is the same for all methods. Only of data
    whose skeleton is given: joints found by us have no names that say something."""
    from tasks.reporting.tables import build, unranked

    given = {c.dataset for c in cases if c.config["skeleton"]["kind"] == "given"}
    found = rows[rows["metric"].str.startswith(f"{DISTANCE}@") & rows["dataset"].isin(given)]
    found = _by_case(found.drop_duplicates(["dataset", "subject", "metric"])).assign(variant="")
    if found.empty:
        return []
    made = unranked(build(found, title=BY_PART, metrics=[DISTANCE], notes=[ON_DISTANCE], **common | {"labels": {}}))
    return [replace(made, folded=True)]


def _part_error_tables(rows, common: dict) -> list:
    """Errors by clip and part, a table for each subject, whose columns are methods."""
    from tasks.reporting.tables import build, unranked

    found = _by_case(
        rows[rows["metric"].str.startswith(f"{PART_ERROR}@") & (rows["variant"] == "")].assign(of=lambda r: r["method"])
    )
    order = {method: place for place, method in enumerate(PART_ERROR_OF)}
    found = found[found["of"].isin(order)].sort_values("of", key=lambda of: of.map(order), kind="stable")
    if found["of"].nunique() < 2:
        return []
    tables = []
    for (_, subject), own in found.groupby(["dataset", "subject"], sort=False):
        title, turned = f"Error by clip and part: {subject}", own.assign(dataset=own["of"], subject="")
        plain = common | {"data_status": {}, "stands_for": {}, "baselines": []}
        made = unranked(build(turned, title=title, metrics=[PART_ERROR], notes=[ON_PART_ERROR], **plain))
        tables.append(replace(made, folded=True))
    return tables


def _rig_tables(cases: list[Case], rows, remarks: list[str], common: dict) -> list:
    """Bones and skeleton: they do not depend on the method, seldom on the variant; a row for each that differs."""
    from tasks.reporting.rows import with_means
    from tasks.reporting.tables import build

    lead = rows[rows["method"] == cases[-1].method].drop_duplicates(["dataset", "subject", "metric", "key", "seed"])
    other = lead["variant"].str.endswith(OTHER_WAYS)
    shared = common | {"labels": common["labels"] | {cases[-1].method: "all methods"}, "baselines": []}
    tables = []
    if rows["metric"].isin(RIG).any():
        notes = ["Errors on the training frames that bones and skeleton were fitted to.", *remarks]
        tables.append(build(lead[~other], title="Bones and skeleton", metrics=RIG, notes=notes, **shared))
    if rows["metric"].isin(TRUTH).any():
        title, notes = "Joints against the true rig", [ON_OTHER_WAYS] if other.any() else []
        tables.append(build(with_means(lead), title=title, metrics=TRUTH, notes=notes, **shared))
    return tables


def _garment_tables(rows, settings: dict, remarks: list[str], common: dict) -> list:
    """The cloth's quality as a whole, then clip by clip."""
    from tasks.reporting.tables import build, unranked

    common |= {"data_status": {}, "stands_for": {}, "baselines": []}
    notes = [*remarks, *([settings["note"]] if settings["note"] else [])]
    shown = [(settings["title"], rows, (*CLOTH, "points_count"), notes), ("Clip by clip", _by_case(rows), CLOTH, [])]
    return [unranked(build(r, title=title, metrics=m, notes=n, **common)) for title, r, m, n in shown]


def _gain_tables(rows, settings: dict, paper, common: dict) -> list:
    """How far each of the methods asked for lies below every other one, beside what the paper prints."""
    from tasks.reporting.gains import GAIN, gains, printed_gains
    from tasks.reporting.tables import build, unranked

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


def _benchmark_tables(cases: list[Case], rows, settings: dict, common: dict) -> list:
    """What decides first, then the numbers behind it; rows are subjects and columns peers, for few are compared."""
    from tasks.reporting.tables import build, unranked

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


def _curve(cases: list[Case], rows, curve: list[str] | None) -> list:
    """A metric against a key of the config: a line for every dataset, or of several methods one chart a dataset."""
    from tasks.drawing.charts import curve_chart, methods_chart
    from tasks.values import Picture

    if not curve:
        return []
    key, metric = curve
    where = {variant_of(c): _at(c.config, key) for c in cases}
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
    from tasks.drawing.charts import ablation_chart, clips_chart
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


def paper_numbers() -> Paper:
    """What the paper prints."""
    from tasks.reporting.paper import paper_of

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


def labels_of(cases: list[Case]) -> dict[str, str]:
    """What to call the methods."""
    return {c.method: c.config["animate"]["label"] for c in cases}


def variant_of(case: Case) -> str:
    """A case's variant as rows call it: none is the empty word."""
    return "" if case.variant == NO_ABLATION else case.variant
