"""Configs: every file composes, and a mistake is one readable line before torch is imported."""

from __future__ import annotations

import re
import subprocess
import sys

import hydra
import pytest
from omegaconf import OmegaConf

from flows import compose, config, ranges, run, schema, source
from flows.source import ROOT
from tasks.errors import InputError

GROUPS = compose.groups()
FILE = ["dataset=mesh_sequence", "dataset.path=some.npz"]
FITTED = ["dataset=scene_figure", "method=gaussians"]
OF_A_FIT = ("scene", "views")  # groups that only a fit has
NEEDS_PATH = ("mesh_sequence", "rigged_character", "vto", "anime", "dnerf", "multiview")


@pytest.mark.parametrize("name", GROUPS["experiment"])
def test_every_experiment_composes(name):
    cases = config.expand([f"+experiment={name}"])
    assert cases
    assert all(case.config["report"]["name"] == name for case in cases)
    assert compose.headline("experiment", name)


@pytest.mark.parametrize("group", [g for g in GROUPS if g not in ("experiment", "ablation")])
def test_every_choice_composes(group):
    for choice in GROUPS[group]:
        extra = ["dataset.path=some.npz"] if group == "dataset" and choice in NEEDS_PATH else []
        extra += ["reconstruction=cpu"] if group in OF_A_FIT else []
        extra += ["split.test=[]"] if choice == "frames" else []  # the creatures name their clips
        sweep = ["sweep.datasets=null", "sweep.methods=null"]
        assert config.expand([f"{group}={choice}", *extra, *sweep])


@pytest.mark.parametrize("name", GROUPS["ablation"])
def test_every_ablation_changes_the_config(name):
    sweep = ["sweep.datasets=null", "sweep.methods=null"]
    sweep += ["reconstruction=cpu"] if name == "no_arap" else []
    plain = config.expand(sweep)[0]
    changed = config.expand([*sweep, f"sweep.ablations=[{name}]"])[0]
    assert changed.variant == name
    assert changed.config | {"sweep": None} != plain.config | {"sweep": None}


def one_line(error: InputError) -> str:
    text = str(error)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["bones.max_bone=3"], ["bones.max_bone", "max_bones", "did you mean max_bones?"]),
        (["nonsense=3"], ["nonsense", "dataset", "bones"]),
        (["bones.max_bones=many"], ["bones.max_bones", "a whole number", "'many'"]),
        (["bones.max_bones=2.5"], ["bones.max_bones", "a whole number", "2.5"]),
        (["bones.max_bones=null"], ["bones.max_bones", "a whole number", "None"]),
        (["animate.align=3"], ["animate.align", "true or false", "3"]),
        (["animate.represent=head"], ["animate.represent", "one of root, part, residual", "'head'"]),
        (["method=nope"], ["method", "partmm", "fullmm", "'nope'"]),
        (["+experiment=nope"], ["experiment", "quick", "table3", "'nope'"]),
        (["experiment=table3"], ["+experiment=table3"]),
        (["+bones.max_bones=3"], ["bones.max_bones", "leave out the sign"]),
        (["~bones.max_bones"], ["bones.max_bones", "leave out the sign"]),
        (["bones.extra=3"], ["bones.extra", "max_bones"]),
        (["method=lbs", "animate.k=3"], ["animate.k", "function"]),
        (["bones"], ["bones", "KEY=VALUE"]),
        (["seed=-1"], ["seed", "0 or more", "-1"]),
        (["sweep.seeds=[0,-2]"], ["sweep.seeds", "0 or more", "-2"]),
        (["memory.max_gb=0"], ["memory.max_gb", "a finite number, above 0", "found 0"]),
        (["animate.k=0"], ["animate.k", "a whole number, 1 or more", "found 0"]),
        (["method=mlp", "animate.rate=-1"], ["animate.rate", "above 0", "found -1"]),
        (["split.observed=1.5"], ["split.observed", "above 0 and at most 1", "found 1.5"]),
        (["runner.workers=0"], ["runner.workers", "1 or more"]),
        (["store.path=''"], ["store.path", "a folder"]),
        (["report.name='a\nb'"], ["report.name", "one line"]),
        (["report.curve=[animate.k]"], ["report.curve", "[animate.k]"]),
        (["report.curve=[animate.nope,rmse]"], ["report.curve", "animate.nope"]),
        (["report.curve=[animate.k,nope]"], ["report.curve", "nope"]),
        (["report.paper_table=99"], ["report.paper_table", "2, 3, 4"]),
        (["report.baselines=[lsb]"], ["report.baselines", "'lsb'", "did you mean lbs?"]),
        (["sweep.seeds_of=[garment_dress]"], ["sweep.seeds_of", "did you mean garments_dress?"]),
        (["report.name=../other"], ["report.name", "../other", "report.path"]),
        (["bones.max_bones="], ["bones.max_bones"]),
        (["bones.max_bones=1,2"], ["bones.max_bones", "add -m"]),
        (["dataset=mesh_sequence", "sweep.datasets=null"], ["dataset.path", "found nothing", "dataset.path="]),
        (["dataset.kind=nope", "sweep.datasets=null"], ["dataset.kind", "mesh_sequence"]),
        (["sweep.ablations=[nope]"], ["ablation", "k_1"]),
        (["sweep.methods=partmm"], ["sweep.methods", "a list"]),
        (["seed=x"], ["seed", "a whole number"]),
        (["split.test=3"], ["split.test", "a list"]),
        (["report.name=${nothing}"], ["nothing"]),
        (["scene=multiview"], ["scene", "a group of this config", "reconstruction=cpu"]),
        ([*FITTED, "reconstruction.max_gaussians=10"], ["reconstruction.max_gaussians", "with gaussians=5000"]),
        ([*FITTED, "reconstruction.grown=0.01"], ["reconstruction.grown", "at least static", "0.01 with static=0.04"]),
        ([*FITTED, "reconstruction.backend=gsplat"], ["reconstruction.backend", "numba with deformation=nodes"]),
        ([*FITTED, "reconstruction.deltas=true"], ["reconstruction.deltas", "false with deformation=nodes"]),
        (["bones.prune=0.3"], ["bones.prune", "below 1 / influences", "0.3 with influences=4"]),
        (["animate.shrink=true"], ["animate.shrink", "represent=residual", "True with represent=root"]),
        (["method=partmm_plus", "animate.shrink=true"], ["animate.shrink", "false with sources", "sources=100"]),
        (["split.by=frames"], ["split.test", "[] where by=frames", "with by=frames", "['gallop', 'jump']"]),
        (["parts.kind=named"], ["parts.named", "one part or more", "arms=arm_l,arm_r"]),
        (["parts.named=['all=body']"], ["parts.named", "nothing without kind=named", "kind=auto"]),
        (["+experiment=benchmark_rasterizer", "benchmark.sizes=[]"], ["benchmark.sizes", "at least one", "found []"]),
        (["+experiment=scale_bones", "benchmark.shares=[1,1]"], ["benchmark.shares", "two or more"]),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else "",
)
def test_a_mistake_is_one_line_that_names_what_would_be_right(overrides, words):
    with pytest.raises(InputError) as caught:
        config.expand(overrides)
    text = one_line(caught.value)
    for word in words:
        assert word in text, text


def test_multirun_is_a_grid_of_variants():
    cases = config.expand(["method=partmm", "bones.max_bones=10,20", "animate.k=1,3", "sweep.methods=null"], True)
    assert [c.variant for c in cases if c.dataset == cases[0].dataset] == [
        f"bones.max_bones={b},animate.k={k}" for b in (10, 20) for k in (1, 3)
    ]
    assert {c.config["bones"]["max_bones"] for c in cases} == {10, 20}


def test_a_pattern_stands_for_the_choices_it_matches():
    cases = config.expand(["method=partmm", "+ablation=glob(k_*)", "sweep.methods=null", "sweep.datasets=null"], True)
    assert [c.variant for c in cases] == [f"ablation={name}" for name in ("k_1", "k_15", "k_3")]
    for nothing in ("+ablation=glob(zz*)", "seed=glob(1*)"):
        with pytest.raises(InputError, match="a pattern that some choice"):
            config.expand([nothing], True)


@pytest.mark.parametrize(
    "name", ["世界.npz", "a(1).npz", "a[1].npz", "it's.npz", "a=b#c.npz", "my rigs/a b.npz", "{x.npz"]
)
def test_files_have_names_of_any_kind(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    own = ["dataset=mesh_sequence", "sweep.datasets=null", "method=lbs", "sweep.methods=null"]
    (case,) = config.expand([*own, f"dataset.path={name}"])
    assert case.config["dataset"]["path"] == name
    (alone,) = config.expand(list(case.alone))
    assert alone.config["dataset"]["path"] == name


def test_a_setting_of_another_type_names_function_and_setting(tmp_path, monkeypatch):
    """As somebody may write it who adds a method."""
    module = tmp_path / "tasks" / "methods" / "mine.py"
    module.parent.mkdir(parents=True)
    monkeypatch.setattr(source, "ROOT", tmp_path)
    for setting, found in (("strength", "strength without a type"), ("strength: np.ndarray", "strength: np.ndarray")):
        module.write_text(f"def animate(training, query, *, {setting}):\n    pass\n")
        source._source.cache_clear()
        source._tree.cache_clear()
        with pytest.raises(InputError, match=rf"tasks\.methods\.mine:animate.*{found}"):
            source.signature("tasks.methods.mine:animate")
    source._source.cache_clear()
    source._tree.cache_clear()


def test_the_experiments_datasets_may_bring_a_group_that_is_chosen():
    cases = config.expand(["+experiment=make_scenes", "scene=multiview", "sweep.datasets=[scene_figure]"])
    assert [c.config["scene"]["layout"] for c in cases] == ["multiview"]


def test_seeds_are_not_variants():
    cases = config.expand(["seed=1,2", "sweep.methods=null", "sweep.datasets=null"], True)
    assert [(c.variant, c.config["seed"]) for c in cases] == [("none", 1), ("none", 2)]


def test_what_the_user_types_wins_over_the_experiment():
    cases = config.expand(["+experiment=ablation_matching", "animate.patch=5"])
    assert all(c.config["animate"]["patch"] == 5 for c in cases)


def test_a_key_that_only_some_methods_have_is_set_in_those():
    cases = config.expand(["animate.k=3"])
    k = {c.method: c.config["animate"].get("k") for c in cases}
    assert (k["lbs"], k["fullmm"], k["partmm"]) == (None, 3, 3)


def test_a_dataset_on_the_command_line_replaces_the_experiments():
    cases = config.expand(["+experiment=table3", *FILE])
    assert {c.dataset for c in cases} == {"mesh_sequence"}
    assert {c.method for c in cases} >= {"lbs", "fullmm", "partmm"}


def test_wildcards_are_one_case_a_file(tmp_path):
    for name in ("b.npz", "a.npz"):
        (tmp_path / name).write_bytes(b"")
    cases = config.expand(["+experiment=table3", "dataset=mesh_sequence", f"dataset.path={tmp_path}/*.npz"])
    assert {c.data for c in cases} == {"mesh_sequence a", "mesh_sequence b"}
    assert {c.variant for c in cases} == {"none"}
    with pytest.raises(InputError, match="nothing that matches"):
        config.expand(["dataset=mesh_sequence", f"dataset.path={tmp_path}/*.obj"])


def test_seeds_are_for_methods_with_randomness():
    cases = config.expand(["sweep.datasets=null", "sweep.methods=[lbs,mlp]", "sweep.seeds=[3,4]"])
    assert [(c.method, c.seed, c.config["seed"]) for c in cases] == [("lbs", 3, 0), ("mlp", 3, 0), ("mlp", 4, 0)]
    some = ["sweep.datasets=[creature_animal,creature_figure]", "sweep.methods=[mlp]", "sweep.seeds=[3,4]"]
    cases = config.expand([*some, "sweep.seeds_of=[creature_figure]"])
    assert [(c.dataset, c.seed) for c in cases] == [
        ("creature_animal", 3),
        ("creature_figure", 3),
        ("creature_figure", 4),
    ]
    fixed = config.expand(["sweep.datasets=null", "sweep.methods=[mlp]", "sweep.seeds=[3,4]", "method_seed=7"])
    assert [c.seed for c in fixed] == [7]
    plain = config.expand(["sweep.datasets=null", "sweep.methods=[mlp]", "seed=5"])
    assert [c.seed for c in plain] == [5]


def test_braces_name_several_files_and_absent_ones_can_be_done_without(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"")
    file = [f"dataset.path='{tmp_path}/{{a,b}}.{{npz,obj}}'", "dataset=mesh_sequence", "sweep.methods=[lbs]"]
    strict = config.expand(file)
    assert [c.data.split()[1] for c in strict] == ["a", "a", "b", "b"]
    assert not any(c.absent for c in strict)
    assert [c.absent for c in config.expand([*file, "sweep.absent=skip"])] == [False, True, True, True]


@pytest.mark.parametrize(
    ("overrides", "multirun"),
    [
        (["+experiment=ablation_bones"], False),
        (["method=partmm", "bones.max_bones=10,20", "animate.k=1,3"], True),
        (["sweep.datasets=null", "sweep.methods=null", "+ablation=k_1", "seed=4"], False),
        (["+experiment=ablation_matching", "sweep.ablations=null", "report.name=mine"], False),
        (["sweep.datasets=null", "sweep.methods=[lbs,mlp]", "sweep.seeds=[3,4]"], False),
        (["animate.k=3"], False),
    ],
    ids=str,
)
def test_a_case_can_be_run_alone_by_its_own_overrides(overrides, multirun):
    for case in config.expand(overrides, multirun):
        (alone,) = config.expand(list(case.alone))
        assert {**alone.config, "sweep": 0, "report": 0} == {**case.config, "sweep": 0, "report": 0}
        assert alone.config["report"]["name"] == config.ALONE


def test_a_file_of_many_can_be_run_alone(tmp_path):
    for name in ("b one's.npz", "a.npz"):
        (tmp_path / name).write_bytes(b"")
    cases = config.expand(["+experiment=table3", "dataset=mesh_sequence", f"dataset.path='{tmp_path}/*.npz'"])
    assert len({c.data for c in cases}) == 2
    for case in cases:
        (alone,) = config.expand(list(case.alone))
        assert alone.config["dataset"] == case.config["dataset"]


def test_a_whole_number_may_stand_for_a_number_and_nothing_else_is_converted():
    expected = {"a": float, "b": int | None, "c": list[str]}
    assert schema.check({"a": 1, "b": None, "c": []}, expected) == {"a": 1.0, "b": None, "c": []}
    assert isinstance(schema.check({"a": 1, "b": 2, "c": []}, expected)["a"], float)
    for wrong in ({"a": True}, {"a": "1"}, {"b": 1.5}, {"c": [[1]]}):
        with pytest.raises(InputError):
            schema.check({"a": 1, "b": 2, "c": []} | wrong, expected)


def test_a_number_out_of_range_is_refused_before_anything_is_begun(tmp_path, capsys):
    store = tmp_path / "store"
    assert run.main(["animate.k=0", f"store.path={store}"]) == 2
    assert capsys.readouterr().err == "error: animate.k: expected a whole number, 1 or more, found 0\n"
    assert not store.exists()


@pytest.mark.parametrize(
    ("text", "inside", "outside", "words"),
    [
        ("[1, inf)", [1, 1e30], [0, 0.999], "1 or more"),
        ("(0, inf)", [1e-30], [0, -1], "above 0"),
        ("[0, 1)", [0, 0.999], [1, -1e-9], "0 or more and below 1"),
        ("(-inf, 2.5]", [-1e30, 2.5], [2.6], "at most 2.5"),
        ("[1e-4, 0.1]", [1e-4, 0.1], [0, 0.2, float("nan")], "0.0001 to 0.1"),
    ],
)
def test_intervals(text, inside, outside, words):
    span = ranges.Interval.of(text)
    assert all(number in span for number in inside)
    assert not any(number in span for number in outside)
    assert str(span) == words


def test_relations_are_about_settings_of_one_function():
    named = set(re.findall(r"tasks\.[\w.]+:\w+", (ROOT / "flows/schema.py").read_text("utf-8")))
    stages = named | {schema.animate_function(path.stem) for path in (ROOT / "tasks/methods").glob("[!_]*.py")}
    found = 0
    for stage in stages:
        settings = source.signature(stage)[1]
        for name, kind in settings.items():
            for relation in ranges.relations(kind):
                assert name in relation.holds.co_names, f"{stage} {name}: {relation.words}"
                assert {*relation.others(name)} <= {*settings}
                assert relation.words
                found += 1
    assert found > 7


@pytest.mark.parametrize("text", ["a <: b", "a < : b", "1 2: words", "a = b: words"])
def test_what_is_no_condition_is_a_defect_of_ours(text):
    with pytest.raises(ValueError, match="condition"):
        ranges.Relation.of(text)


@pytest.mark.parametrize("text", ["0..1", "[1, 0]", "[1, 1)", "1 or more", "[0 1]"])
def test_what_is_no_interval_is_a_defect_of_ours(text):
    with pytest.raises(ValueError, match="interval"):
        ranges.Interval.of(text)


def command(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "flows.run", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize("arguments", [["--help"], ["bones.max_bone=3"], ["--cfg"]])
def test_help_and_mistakes_import_neither_torch_nor_prefect(arguments):
    done = command(*arguments)
    assert done.returncode == (2 if "bone" in arguments[0] else 0)
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if "import time" in line}
    assert not imported & {"torch", "prefect", "numba", "pandas"}
    said = [line for line in done.stderr.splitlines() if not line.startswith("import time")]
    assert len(said) == (1 if done.returncode else 0)


@pytest.mark.parametrize(
    "chosen",
    [
        ("+experiment=table3_full", "dataset=quaternius", "method=mlp", "+ablation=[k_1,smooth]"),
        ("+experiment=table4", "dataset=scene_dress", "method=bob", "+ablation=[clusters]"),
        ("dataset=scene_figure", "reconstruction=cpu", "+ablation=[no_arap,frames_50]"),
    ],
)
def test_configs_compose_as_hydra_composes_them(chosen):
    with hydra.initialize_config_dir(str(compose.CONF), version_base="1.3"):
        plain = OmegaConf.to_container(hydra.compose("config", list(chosen)))
    assert repr(OmegaConf.to_container(compose.compose(chosen))) == repr(plain)
