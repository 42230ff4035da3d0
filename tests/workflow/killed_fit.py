"""A fit of Gaussians as a process of its own, to be killed.

Brings a tiny rendered scene, and Gaussians fitted to it, to a store; the state is kept after every few steps, so that a
kill finds the fit anywhere in its course.
"""

from __future__ import annotations

import sys

from flows import config
from flows.engine import job_of
from flows.graph import Graph
from flows.pipeline import plan
from flows.stage import run
from tasks.reconstruction import fitting

SCENE = ["scene.size=40", "scene.frames=8", "scene.views=24", "scene.test_views=2", "scene.samples=1"]
FIT = ["iterations=500", "gaussians=300", "max_gaussians=500", "carriers=32", "divide_every=50", "hull_cells=32"]
CASE = ["dataset=scene_figure", "method=gaussians", *SCENE, *(f"reconstruction.{s}" for s in FIT)]


def main(store: str) -> None:
    """Every stage up to the fit, from the store where it is there."""
    fitting.SAVE_SECONDS = 0.02
    graph = Graph()
    (case,) = config.expand([*CASE, f"store.path={store}"])
    wanted = plan(case, graph).nodes["reconstruction"][0]
    refs: dict = {}
    for node in graph.nodes.values():
        refs[node.id] = run(job_of(node, refs, case.config, None))
        if node is wanted:
            return


if __name__ == "__main__":
    main(sys.argv[1])
