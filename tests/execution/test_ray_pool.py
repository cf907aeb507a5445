"""Tests of a Ray cluster of several nodes on this machine.

The result files equal those without a cluster, also if nodes join or fail.
"""

import inspect
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.errors import DataFormatError, PolicyError, WorkerError
from handover_marl.evaluation import benchmark as evaluation
from handover_marl.receivers import Receiver
from tests.evaluation.test_workers import files
from tests.helpers.equality import assert_equal

ray = pytest.importorskip("ray", reason="needs the extra `ray`")
cluster_utils = pytest.importorskip("ray.cluster_utils")
NodeAffinitySchedulingStrategy = pytest.importorskip("ray.util.scheduling_strategies").NodeAffinitySchedulingStrategy
services = pytest.importorskip("ray._private.services")
raylet = pytest.importorskip("ray._raylet")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

SCENES = (9, 14, 19, 24)
HORIZON = 300
PATIENCE = 200  # s
#: Environment variable of a node. If it names a file, an episode creates the file and then waits for PATIENCE.
STUCK_VARIABLE = "HANDOVER_MARL_TEST_STUCK"
OPTIONS: dict[str, Any] = {
    **{"setup": "s0", "split": "val", "dataset": "synthetic", "physics": "fast", "scenes": SCENES, "progress": False},
    **{"world_config": WorldConfig(protocol=ProtocolConfig(horizon_steps=HORIZON)), "giver": "noisy"},
}


def swaying() -> type[Receiver]:
    """Return a receiver class that no other process can import, like a class in a notebook."""

    class Swaying(Receiver):
        name = "swaying"
        control_period = 0.05

        def reset(self, seed: int | None = None) -> None:
            self.rng = np.random.default_rng(seed)
            if stuck := os.environ.get(STUCK_VARIABLE):
                Path(stuck).touch()
                time.sleep(PATIENCE)

        def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
            return observation["robot_joint_position"] + 0.05 * self.rng.normal(size=9).astype(np.float32)

    return Swaying


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Yield a Ray cluster whose head node runs no tasks; tests add further nodes."""
    patience = {"worker_register_timeout_seconds": PATIENCE, "agent_register_timeout_ms": 1000 * PATIENCE}
    patience |= {"health_check_failure_threshold": 50}
    head = {"num_cpus": 0, "include_dashboard": False, "no_monitor": True, "_system_config": patience, **light()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(services, "start_raylet", without_waiting(services.start_raylet))
        patch.setattr(services, "get_node", patiently(services.get_node))
        made = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
        try:
            yield made
        finally:
            ray.shutdown()
            made.shutdown()


def light() -> dict[str, Any]:
    """Return the options of a node without optional services.

    The runtime environment agent gets a free port, because Ray waits only briefly for a port that it finds itself.
    """
    with socket.socket() as one:
        one.bind(("", 0))
        return {"include_log_monitor": False, "runtime_env_agent_port": one.getsockname()[1]}


def without_waiting(start: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that starts a node and reports beforehand that its agent has no ports.

    Ray waits 15 s for the agent itself to report it, which is too short if other tests use the cores.
    """

    def started(*args: Any, **kwargs: Any) -> Any:
        message = inspect.signature(start).bind(*args, **kwargs).arguments
        for service in ("DASHBOARD_AGENT_LISTEN_PORT_NAME", "METRICS_AGENT_PORT_NAME", "METRICS_EXPORT_PORT_NAME"):
            raylet.persist_port(message["session_dir"], message["node_id"], getattr(raylet, service), -1)
        return start(*args, **kwargs)

    return started


def patiently(ask: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that asks for a node again until PATIENCE, because Ray's own limit of 30 s may be too short."""

    def asked(*args: Any, **kwargs: Any) -> Any:
        until = time.monotonic() + PATIENCE
        while True:
            try:
                return ask(*args, **kwargs)
            except RuntimeError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.5)

    return asked


def add_node(cluster: Any, **options: Any) -> Any:
    """Add a node of one core to a cluster, and return it."""
    return cluster.add_node(num_cpus=1, **light(), **options)


@pytest.fixture(scope="module")
def nodes(cluster: Any) -> Iterator[list[Any]]:
    """Yield two nodes of one core each, and remove all nodes at the end."""
    yield [add_node(cluster) for _ in range(2)]
    for node in list(cluster.worker_nodes):
        cluster.remove_node(node)


def play(cluster: Any, out: Path | None = None, **options: Any) -> handover_marl.Report:
    named = {**OPTIONS, "receiver": swaying(), "ray_address": cluster.address, "out": out, **options}
    return handover_marl.evaluate_pair(**named)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the result folder of an evaluation on this machine without a cluster."""
    out = tmp_path_factory.mktemp("alone") / "out"
    handover_marl.evaluate_pair(**{**OPTIONS, "receiver": swaying(), "workers": 1, "out": out})
    return out


def assert_same(one: Path, other: Path) -> None:
    """Check that two result folders are equal, except for times and machines."""
    assert sorted(path.name for path in one.iterdir()) == sorted(path.name for path in other.iterdir())
    assert (one / "config.yaml").read_bytes() == (other / "config.yaml").read_bytes()
    assert_equal(files(one), files(other))


def test_data_folders_of_nodes(
    cluster: Any, fake_data: Path, own_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nodes read the data folder that their environment names; data that differ are refused."""
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(fake_data))
    meta = own_data / "dex-ycb-cache" / "meta_009.json"
    meta.write_text(meta.read_text() + " ")
    node = add_node(cluster, env_vars={DATA_DIR_VARIABLE: str(own_data)})
    options = {"dataset": "dexycb", "receiver": "hold"}
    try:
        play(cluster, tmp_path / "out", scenes=[14], **options)
        assert len(files(tmp_path / "out")) == 1
        message = "scene 9 on .* differs from the requested one .*every node needs the same"
        with pytest.raises(DataFormatError, match=message):
            play(cluster, scenes=[9], **options)
    finally:
        cluster.remove_node(node)


def test_failures(cluster: Any, nodes: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of policies and dying workers are reported with their scene, and an interruption frees the cores."""

    class Failing(swaying()):  # type: ignore[misc]
        def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
            if observation["object_classes"][0] == 5:  # the mustard bottle, which is given in scene 24
                os._exit(3)
            raise KeyError("nonsense")

    with pytest.raises(PolicyError, match=r"(?s)receiver 'swaying' .*in scene 9: .*KeyError.*nonsense"):
        play(cluster, receiver=Failing, scenes=[9])
    with pytest.raises(WorkerError, match="a worker process died twice while simulating scene 24 "):
        play(cluster, receiver=Failing, scenes=[24])

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "_check_same_outcome", stopped)
        with pytest.raises(KeyboardInterrupt):
            play(cluster)
    until = time.monotonic() + 30.0
    while ray.available_resources().get("CPU", 0.0) < 2.0:
        assert time.monotonic() < until
        time.sleep(0.1)


def test_results_are_the_same_if_a_node_dies(cluster: Any, nodes: list[Any], alone: Path, tmp_path: Path) -> None:
    """Results stay the same if a node is killed while it simulates a scene; the node creates a file to show this."""
    playing = tmp_path / "playing"
    doomed = add_node(cluster, env_vars={STUCK_VARIABLE: str(playing)})
    # Without a process of its own, the node might start to work when the others have finished all scenes.
    ray.init(cluster.address, ignore_reinit_error=True, logging_level="error")
    strategy = NodeAffinitySchedulingStrategy(doomed.node_id, soft=False)
    ray.get(ray.remote(num_cpus=1, scheduling_strategy=strategy)(lambda: None).remote())

    def kill_when_playing() -> None:
        until = time.monotonic() + PATIENCE
        while not playing.exists() and time.monotonic() < until:
            time.sleep(0.1)
        cluster.remove_node(doomed, allow_graceful=False)

    killer = threading.Thread(target=kill_when_playing)
    killer.start()
    try:
        report = play(cluster, tmp_path / "out")
    finally:
        killer.join()
    assert playing.exists()
    assert "3 at a time on a Ray cluster" in str(report.episodes[0].machine)
    assert_same(tmp_path / "out", alone)
