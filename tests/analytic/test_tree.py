"""Kinematic trees from graphs worked out by hand."""

from __future__ import annotations

import numpy as np

from tasks.skeleton.resample import branch_paths, resample
from tasks.skeleton.runs import find_runs
from tasks.skeleton.tree import contract, kinematic_tree, link_components

# a letter T: a bar from (0, 0) to (4, 0) with a stem from (2, 0) down to (2, -3)
NODES = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0], [2, -1, 0], [2, -2, 0], [2, -3, 0]])
EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [2, 5], [5, 6], [6, 7]])


def test_the_tree_hangs_from_the_root_with_parents_first():
    links, costs = contract(NODES, EDGES, np.array([0, 2, 4, 7]))
    order, parents = kinematic_tree(links, costs, root=1, count=4)
    assert order[0] == 1
    assert parents.tolist() == [-1, 0, 0, 0]
    order, parents = kinematic_tree(links, costs, root=3, count=4)
    assert order[:2].tolist() == [3, 1]
    assert parents.tolist() == [-1, 0, 1, 1]


def test_links_have_the_length_of_the_curve_between_their_joints():
    links, costs = contract(NODES, EDGES, np.array([0, 2, 4, 7]))
    found = {tuple(sorted(link)): cost for link, cost in zip(links.tolist(), costs, strict=True)}
    assert found == {(0, 1): 2.0, (1, 2): 2.0, (1, 3): 3.0}


def test_of_a_loop_the_longest_link_is_cut():
    order, parents = kinematic_tree(np.array([[0, 1], [1, 2], [0, 2]]), np.array([1.0, 1.0, 3.0]), root=0, count=3)
    assert order.tolist() == [0, 1, 2]
    assert parents.tolist() == [-1, 0, 1]


def test_one_joint_is_a_tree():
    order, parents = kinematic_tree(np.zeros((0, 2), int), np.zeros(0), root=0, count=1)
    assert order.tolist() == [0]
    assert parents.tolist() == [-1]


def test_pieces_are_bridged_where_they_are_nearest():
    edges = link_components(NODES, EDGES[[0, 1, 2, 4, 5, 6]][1:])  # nodes 0 and 4 are now alone
    added = {tuple(sorted(e)) for e in edges.tolist()} - {tuple(e) for e in EDGES.tolist()}
    assert added == set()
    assert len(edges) == 7


def test_branches_run_between_leaves_and_junctions():
    paths = {tuple(p) for p in branch_paths(EDGES, len(NODES))}
    assert paths == {(0, 1, 2), (2, 3, 4), (2, 5, 6, 7)}


def test_resampling_is_even_and_keeps_linear_weights():
    weights = NODES[:, [0]] / 4.0
    for branch in resample(NODES, EDGES, weights, 0.3):
        steps = np.linalg.norm(np.diff(branch.points, axis=0), axis=1)
        np.testing.assert_allclose(steps, branch.spacing)
        assert 0.2 < branch.spacing < 0.4
        np.testing.assert_allclose(branch.weights[:, 0], branch.points[:, 0] / 4.0)


def test_runs_follow_the_dominant_bone_and_short_ones_are_absorbed():
    nodes = np.stack([np.arange(30.0), np.zeros(30), np.zeros(30)], axis=1)
    edges = np.stack([np.arange(29), np.arange(1, 30)], axis=1)
    label = np.repeat([0, 1, 0, 2], [10, 8, 1, 11])
    turn = np.full((3, 3), 1.0) - np.eye(3)
    runs = find_runs(nodes, edges, np.eye(3)[label], np.ones(30), turn, shortest=2.5, angle=0.1, at_most=9)
    assert runs.bone[runs.of_node[[0, 12, 28]]].tolist() == [0, 1, 2]
    assert len(runs.bone) == 3
    assert sorted(runs.boundary[:, 0].round().tolist()) in ([10.0, 18.0], [9.0, 18.0], [10.0, 19.0], [9.0, 19.0])


def test_runs_that_do_not_turn_are_one_and_the_ceiling_holds():
    nodes = np.stack([np.arange(30.0), np.zeros(30), np.zeros(30)], axis=1)
    edges = np.stack([np.arange(29), np.arange(1, 30)], axis=1)
    weights = np.eye(3)[np.repeat([0, 1, 2], 10)]
    turn = np.array([[0.0, 0.01, 1.0], [0.01, 0.0, 1.0], [1.0, 1.0, 0.0]])
    settings = {"shortest": 1.0, "angle": 0.1}
    assert len(find_runs(nodes, edges, weights, np.ones(30), turn, **settings, at_most=9).bone) == 2
    assert len(find_runs(nodes, edges, weights, np.ones(30), turn, **settings, at_most=1).bone) == 1
