"""Sweeps on a Ray cluster of two nodes on this machine."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.common.processes import is_running
from tests.policies.sweep.harness import (
    LINUX,
    assert_resumed,
    held,
    kill,
    make_runs,
    signal_worker,
    steps,
    sweep,
    wait_until,
)

from gelflow.policies.sweep.engines.ray import RayEngine
from gelflow.policies.sweep.run import Run, read_record

pytest.importorskip("ray", reason="Ray is not installed (pip install 'gelflow[ray]')")


def start_head() -> Any:
    """A cluster with a head node. Ray itself waits 30 s only, which a busy machine may exceed."""
    from ray.cluster_utils import Cluster

    for left in (2, 1, 0):
        try:
            return Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        except Exception:
            if not left:
                raise


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes with one processor each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        # Workers import the tests; on a real cluster gelflow is installed.
        paths = [str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")])]
        patch.setenv("PYTHONPATH", os.pathsep.join(paths))
        made = start_head()
        patch.setenv("RAY_ADDRESS", made.address)
        made.add_node(num_cpus=1)
        yield made
        made.shutdown()


def node(run: Run) -> str:
    """Start of the identifier of the node that executed the last start of a run."""
    return read_record(run).machine.split("/")[1]


def test_runs_are_spread_over_the_nodes_and_a_killed_one_continues(tmp_path: Path, cluster: Any) -> None:
    first, second = runs = make_runs(tmp_path)
    nodes: set[str] = set()

    def note_nodes_and_kill() -> None:
        nodes.update(map(node, runs))
        kill(first)

    with held(runs, note_nodes_and_kill):
        ended = sweep(runs, RayEngine)
    assert sorted(state for _, state, _ in ended) == ["complete", "complete", "failed"]
    assert nodes == {made.node_id[: len(node(first))] for made in (cluster.head_node, *cluster.worker_nodes)}
    assert_resumed(first)
    assert read_record(second).starts == 1


@LINUX
def test_a_run_survives_the_death_of_its_worker(tmp_path: Path, cluster: Any) -> None:
    (run,) = make_runs(tmp_path)[:1]
    with held([run], lambda: signal_worker(run, signal.SIGKILL)):
        ended = sweep([run], RayEngine)
    assert ended == [(run.name, "failed", True), (run.name, "complete", False)]
    assert_resumed(run)
    assert run.log.read_text().count("=== start ") == 2


@LINUX
def test_a_run_survives_the_death_of_its_node(tmp_path: Path, cluster: Any) -> None:
    """The last test: it leaves one node."""
    runs = make_runs(tmp_path)
    (lost_node,) = cluster.worker_nodes
    lost: list[Run] = []

    def remove_node() -> None:
        (run,) = [run for run in runs if lost_node.node_id.startswith(node(run))]
        process = steps(run)[-1][1]
        lost.append(run)
        cluster.remove_node(lost_node, allow_graceful=False)
        wait_until(lambda: not is_running(process))

    with held(runs, remove_node):
        ended = sweep(runs, RayEngine)
    (run,) = lost
    assert (run.name, "failed", True) in ended and len(ended) == 3
    assert_resumed(run)
    assert cluster.head_node.node_id.startswith(node(run))
